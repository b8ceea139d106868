CREATE INDEX gap_by_robot ON gap (site_id, robot_id, position)
