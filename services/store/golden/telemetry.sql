CREATE TABLE frame_coarse (
    site_id TEXT NOT NULL,
    position BIGINT NOT NULL,
    UNIQUE (site_id)
);

CREATE TABLE frame_head (
    site_id TEXT NOT NULL,
    marked_position BIGINT NOT NULL,
    UNIQUE (site_id)
);

CREATE TABLE frame_log (
    site_id TEXT NOT NULL,
    position BIGINT NOT NULL,
    at_unix_ms BIGINT NOT NULL,
    size BIGINT NOT NULL,
    body BLOB NOT NULL,
    UNIQUE (site_id, position)
);

CREATE TABLE frame_mark (
    site_id TEXT NOT NULL,
    robot_id TEXT NOT NULL,
    ring TEXT NOT NULL,
    seq BIGINT NOT NULL,
    UNIQUE (site_id, robot_id, ring)
);

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
);

CREATE TABLE schema_version (version BIGINT NOT NULL, name TEXT NOT NULL, UNIQUE (version));

CREATE INDEX gap_by_robot ON gap (site_id, robot_id, position);

