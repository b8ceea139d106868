CREATE INDEX task_state_by_parent ON task_state (site_id, parent, ord, id)
