CREATE INDEX identity_audit_by_ord ON identity_audit (site_id, ord, id)
