CREATE INDEX rollout_robot_by_state ON rollout_robot (site_id, state, ord, id)
