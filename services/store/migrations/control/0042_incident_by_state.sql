CREATE INDEX incident_by_state ON incident (site_id, state, ord, id)
