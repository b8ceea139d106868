CREATE INDEX stop_event_by_subject ON stop_event (site_id, subject, seq)
