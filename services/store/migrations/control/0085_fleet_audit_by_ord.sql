CREATE INDEX fleet_audit_by_ord ON fleet_audit (site_id, ord, id)
