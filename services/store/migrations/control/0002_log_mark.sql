CREATE TABLE log_mark (
    site_id TEXT NOT NULL,
    log TEXT NOT NULL,
    pruned_seq BIGINT NOT NULL,
    UNIQUE (site_id, log)
)
