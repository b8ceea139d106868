CREATE INDEX task_request_by_parent ON task_request (site_id, parent, ord, id)
