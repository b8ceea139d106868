CREATE INDEX ota_event_by_subject ON ota_event (site_id, subject, seq)
