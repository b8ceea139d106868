CREATE INDEX task_request_by_ord ON task_request (site_id, ord, id)
