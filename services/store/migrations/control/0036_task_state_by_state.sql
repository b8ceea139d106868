CREATE INDEX task_state_by_state ON task_state (site_id, state, ord, id)
