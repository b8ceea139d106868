CREATE INDEX timer_by_ord ON timer (site_id, ord, id)
