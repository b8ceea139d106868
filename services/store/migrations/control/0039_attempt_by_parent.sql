CREATE INDEX attempt_by_parent ON attempt (site_id, parent, ord, id)
