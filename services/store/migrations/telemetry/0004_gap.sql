CREATE TABLE gap (
    site_id TEXT NOT NULL,
    position BIGINT NOT NULL,
    robot_id TEXT NOT NULL,
    ring TEXT NOT NULL,
    lane TEXT NOT NULL,
    from_seq BIGINT NOT NULL,
    to_seq BIGINT NOT NULL,
    reason TEXT NOT NULL,
    at_unix_ms BIGINT NOT NULL,
    UNIQUE (site_id, position)
)
