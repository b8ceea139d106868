CREATE TABLE robot_last_head (
    site_id TEXT NOT NULL,
    position BIGINT NOT NULL,
    UNIQUE (site_id)
)
