CREATE INDEX task_intake_by_ord ON task_intake (site_id, ord, id)
