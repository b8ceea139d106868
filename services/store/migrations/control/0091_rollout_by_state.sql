CREATE INDEX rollout_by_state ON rollout (site_id, state, ord, id)
