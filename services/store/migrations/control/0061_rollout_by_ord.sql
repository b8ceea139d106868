CREATE INDEX rollout_by_ord ON rollout (site_id, ord, id)
