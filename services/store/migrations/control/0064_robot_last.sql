CREATE TABLE robot_last (
    site_id TEXT NOT NULL,
    robot_id TEXT NOT NULL,
    position BIGINT NOT NULL,
    session_epoch BIGINT NOT NULL,
    hb BIGINT NOT NULL,
    body TEXT NOT NULL,
    UNIQUE (site_id, robot_id)
)
