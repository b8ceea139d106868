CREATE INDEX attempt_by_state ON attempt (site_id, state, ord, id)
