CREATE INDEX fleet_event_by_subject ON fleet_event (site_id, subject, seq)
