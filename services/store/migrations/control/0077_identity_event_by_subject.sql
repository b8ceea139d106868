CREATE INDEX identity_event_by_subject ON identity_event (site_id, subject, seq)
