CREATE TABLE task_type (
    site_id TEXT NOT NULL,
    id TEXT NOT NULL,
    revision BIGINT NOT NULL,
    state BIGINT,
    parent TEXT,
    ord BIGINT NOT NULL,
    body TEXT NOT NULL,
    UNIQUE (site_id, id)
)
