CREATE INDEX task_state_by_ord ON task_state (site_id, ord, id)
