CREATE INDEX fleet_event_by_attempt ON fleet_event (site_id, subject, seq) WHERE tbl = 'attempt'
