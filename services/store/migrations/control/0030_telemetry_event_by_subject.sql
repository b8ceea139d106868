CREATE INDEX telemetry_event_by_subject ON telemetry_event (site_id, subject, seq)
