CREATE INDEX rollout_robot_by_parent ON rollout_robot (site_id, parent, ord, id)
