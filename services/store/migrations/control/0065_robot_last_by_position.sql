CREATE INDEX robot_last_by_position ON robot_last (site_id, position)
