CREATE INDEX task_event_by_request_key ON task_event (site_id, subject, seq) WHERE tbl = 'request_key'
