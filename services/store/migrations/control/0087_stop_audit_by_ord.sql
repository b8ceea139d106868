CREATE INDEX stop_audit_by_ord ON stop_audit (site_id, ord, id)
