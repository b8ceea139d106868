CREATE INDEX request_key_by_ord ON request_key (site_id, ord, id)
