CREATE TABLE store_head (
    site_id TEXT NOT NULL,
    store_id TEXT NOT NULL,
    seq BIGINT NOT NULL,
    UNIQUE (site_id)
)
