CREATE TABLE audit_head (
    site_id TEXT NOT NULL,
    chain TEXT NOT NULL,
    n BIGINT NOT NULL,
    hash TEXT NOT NULL,
    UNIQUE (site_id, chain)
)
