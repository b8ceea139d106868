CREATE INDEX incident_by_ord ON incident (site_id, ord, id)
