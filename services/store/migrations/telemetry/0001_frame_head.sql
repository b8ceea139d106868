CREATE TABLE frame_head (
    site_id TEXT NOT NULL,
    marked_position BIGINT NOT NULL,
    UNIQUE (site_id)
)
