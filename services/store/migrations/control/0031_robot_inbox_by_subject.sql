CREATE INDEX robot_inbox_by_subject ON robot_inbox (site_id, subject, seq)
