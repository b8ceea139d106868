CREATE INDEX bundle_by_ord ON bundle (site_id, ord, id)
