CREATE TABLE frame_log (
    site_id TEXT NOT NULL,
    position BIGINT NOT NULL,
    at_unix_ms BIGINT NOT NULL,
    size BIGINT NOT NULL,
    body BLOB NOT NULL,
    UNIQUE (site_id, position)
)
