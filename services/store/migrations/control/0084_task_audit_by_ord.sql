CREATE INDEX task_audit_by_ord ON task_audit (site_id, ord, id)
