CREATE TABLE frame_coarse (
    site_id TEXT NOT NULL,
    position BIGINT NOT NULL,
    UNIQUE (site_id)
)
