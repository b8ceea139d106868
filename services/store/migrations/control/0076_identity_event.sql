CREATE TABLE identity_event (
    site_id TEXT NOT NULL,
    seq BIGINT NOT NULL,
    tbl TEXT,
    subject TEXT NOT NULL,
    revision BIGINT NOT NULL,
    state BIGINT,
    parent TEXT,
    ord BIGINT,
    body TEXT,
    kind TEXT NOT NULL,
    actor TEXT NOT NULL,
    request_id TEXT,
    at_unix_ms BIGINT NOT NULL,
    UNIQUE (site_id, seq)
)
