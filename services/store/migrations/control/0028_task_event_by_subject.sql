CREATE INDEX task_event_by_subject ON task_event (site_id, subject, seq)
