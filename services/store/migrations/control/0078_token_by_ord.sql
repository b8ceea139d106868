CREATE INDEX token_by_ord ON token (site_id, ord, id)
