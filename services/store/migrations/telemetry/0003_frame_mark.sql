CREATE TABLE frame_mark (
    site_id TEXT NOT NULL,
    robot_id TEXT NOT NULL,
    ring TEXT NOT NULL,
    seq BIGINT NOT NULL,
    UNIQUE (site_id, robot_id, ring)
)
