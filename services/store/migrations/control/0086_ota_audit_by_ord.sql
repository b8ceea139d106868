CREATE INDEX ota_audit_by_ord ON ota_audit (site_id, ord, id)
