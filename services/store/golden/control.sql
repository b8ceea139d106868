CREATE TABLE area_budget (
    site_id TEXT NOT NULL,
    id TEXT NOT NULL,
    revision BIGINT NOT NULL,
    state BIGINT,
    parent TEXT,
    ord BIGINT NOT NULL,
    body TEXT NOT NULL,
    UNIQUE (site_id, id)
);

CREATE TABLE area_bundle (
    site_id TEXT NOT NULL,
    id TEXT NOT NULL,
    revision BIGINT NOT NULL,
    state BIGINT,
    parent TEXT,
    ord BIGINT NOT NULL,
    body TEXT NOT NULL,
    UNIQUE (site_id, id)
);

CREATE TABLE area_policy (
    site_id TEXT NOT NULL,
    id TEXT NOT NULL,
    revision BIGINT NOT NULL,
    state BIGINT,
    parent TEXT,
    ord BIGINT NOT NULL,
    body TEXT NOT NULL,
    UNIQUE (site_id, id)
);

CREATE TABLE attempt (
    site_id TEXT NOT NULL,
    id TEXT NOT NULL,
    revision BIGINT NOT NULL,
    state BIGINT,
    parent TEXT,
    ord BIGINT NOT NULL,
    body TEXT NOT NULL,
    UNIQUE (site_id, id)
);

CREATE TABLE audit_head (
    site_id TEXT NOT NULL,
    chain TEXT NOT NULL,
    n BIGINT NOT NULL,
    hash TEXT NOT NULL,
    UNIQUE (site_id, chain)
);

CREATE TABLE authority (
    site_id TEXT NOT NULL,
    id TEXT NOT NULL,
    revision BIGINT NOT NULL,
    state BIGINT,
    parent TEXT,
    ord BIGINT NOT NULL,
    body TEXT NOT NULL,
    UNIQUE (site_id, id)
);

CREATE TABLE bundle (
    site_id TEXT NOT NULL,
    id TEXT NOT NULL,
    revision BIGINT NOT NULL,
    state BIGINT,
    parent TEXT,
    ord BIGINT NOT NULL,
    body TEXT NOT NULL,
    UNIQUE (site_id, id)
);

CREATE TABLE command_key (
    site_id TEXT NOT NULL,
    id TEXT NOT NULL,
    revision BIGINT NOT NULL,
    state BIGINT,
    parent TEXT,
    ord BIGINT NOT NULL,
    body TEXT NOT NULL,
    UNIQUE (site_id, id)
);

CREATE TABLE desired_policy (
    site_id TEXT NOT NULL,
    id TEXT NOT NULL,
    revision BIGINT NOT NULL,
    state BIGINT,
    parent TEXT,
    ord BIGINT NOT NULL,
    body TEXT NOT NULL,
    UNIQUE (site_id, id)
);

CREATE TABLE desired_update (
    site_id TEXT NOT NULL,
    id TEXT NOT NULL,
    revision BIGINT NOT NULL,
    state BIGINT,
    parent TEXT,
    ord BIGINT NOT NULL,
    body TEXT NOT NULL,
    UNIQUE (site_id, id)
);

CREATE TABLE desired_work (
    site_id TEXT NOT NULL,
    id TEXT NOT NULL,
    revision BIGINT NOT NULL,
    state BIGINT,
    parent TEXT,
    ord BIGINT NOT NULL,
    body TEXT NOT NULL,
    UNIQUE (site_id, id)
);

CREATE TABLE drain (
    site_id TEXT NOT NULL,
    id TEXT NOT NULL,
    revision BIGINT NOT NULL,
    state BIGINT,
    parent TEXT,
    ord BIGINT NOT NULL,
    body TEXT NOT NULL,
    UNIQUE (site_id, id)
);

CREATE TABLE drain_release (
    site_id TEXT NOT NULL,
    id TEXT NOT NULL,
    revision BIGINT NOT NULL,
    state BIGINT,
    parent TEXT,
    ord BIGINT NOT NULL,
    body TEXT NOT NULL,
    UNIQUE (site_id, id)
);

CREATE TABLE drain_request (
    site_id TEXT NOT NULL,
    id TEXT NOT NULL,
    revision BIGINT NOT NULL,
    state BIGINT,
    parent TEXT,
    ord BIGINT NOT NULL,
    body TEXT NOT NULL,
    UNIQUE (site_id, id)
);

CREATE TABLE fleet_audit (
    site_id TEXT NOT NULL,
    id TEXT NOT NULL,
    revision BIGINT NOT NULL,
    state BIGINT,
    parent TEXT,
    ord BIGINT NOT NULL,
    body TEXT NOT NULL,
    UNIQUE (site_id, id)
);

CREATE TABLE fleet_event (
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
);

CREATE TABLE fleet_leader (
    site_id TEXT NOT NULL,
    id TEXT NOT NULL,
    revision BIGINT NOT NULL,
    state BIGINT,
    parent TEXT,
    ord BIGINT NOT NULL,
    body TEXT NOT NULL,
    UNIQUE (site_id, id)
);

CREATE TABLE fleet_mark (
    site_id TEXT NOT NULL,
    id TEXT NOT NULL,
    revision BIGINT NOT NULL,
    state BIGINT,
    parent TEXT,
    ord BIGINT NOT NULL,
    body TEXT NOT NULL,
    UNIQUE (site_id, id)
);

CREATE TABLE hold_token (
    site_id TEXT NOT NULL,
    id TEXT NOT NULL,
    revision BIGINT NOT NULL,
    state BIGINT,
    parent TEXT,
    ord BIGINT NOT NULL,
    body TEXT NOT NULL,
    UNIQUE (site_id, id)
);

CREATE TABLE identity_audit (
    site_id TEXT NOT NULL,
    id TEXT NOT NULL,
    revision BIGINT NOT NULL,
    state BIGINT,
    parent TEXT,
    ord BIGINT NOT NULL,
    body TEXT NOT NULL,
    UNIQUE (site_id, id)
);

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
);

CREATE TABLE incident (
    site_id TEXT NOT NULL,
    id TEXT NOT NULL,
    revision BIGINT NOT NULL,
    state BIGINT,
    parent TEXT,
    ord BIGINT NOT NULL,
    body TEXT NOT NULL,
    UNIQUE (site_id, id)
);

CREATE TABLE lane_mark (
    site_id TEXT NOT NULL,
    id TEXT NOT NULL,
    revision BIGINT NOT NULL,
    state BIGINT,
    parent TEXT,
    ord BIGINT NOT NULL,
    body TEXT NOT NULL,
    UNIQUE (site_id, id)
);

CREATE TABLE log_mark (
    site_id TEXT NOT NULL,
    log TEXT NOT NULL,
    pruned_seq BIGINT NOT NULL,
    UNIQUE (site_id, log)
);

CREATE TABLE ota_audit (
    site_id TEXT NOT NULL,
    id TEXT NOT NULL,
    revision BIGINT NOT NULL,
    state BIGINT,
    parent TEXT,
    ord BIGINT NOT NULL,
    body TEXT NOT NULL,
    UNIQUE (site_id, id)
);

CREATE TABLE ota_clock (
    site_id TEXT NOT NULL,
    id TEXT NOT NULL,
    revision BIGINT NOT NULL,
    state BIGINT,
    parent TEXT,
    ord BIGINT NOT NULL,
    body TEXT NOT NULL,
    UNIQUE (site_id, id)
);

CREATE TABLE ota_command_key (
    site_id TEXT NOT NULL,
    id TEXT NOT NULL,
    revision BIGINT NOT NULL,
    state BIGINT,
    parent TEXT,
    ord BIGINT NOT NULL,
    body TEXT NOT NULL,
    UNIQUE (site_id, id)
);

CREATE TABLE ota_event (
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
);

CREATE TABLE ota_leader (
    site_id TEXT NOT NULL,
    id TEXT NOT NULL,
    revision BIGINT NOT NULL,
    state BIGINT,
    parent TEXT,
    ord BIGINT NOT NULL,
    body TEXT NOT NULL,
    UNIQUE (site_id, id)
);

CREATE TABLE ota_mark (
    site_id TEXT NOT NULL,
    id TEXT NOT NULL,
    revision BIGINT NOT NULL,
    state BIGINT,
    parent TEXT,
    ord BIGINT NOT NULL,
    body TEXT NOT NULL,
    UNIQUE (site_id, id)
);

CREATE TABLE place_block (
    site_id TEXT NOT NULL,
    id TEXT NOT NULL,
    revision BIGINT NOT NULL,
    state BIGINT,
    parent TEXT,
    ord BIGINT NOT NULL,
    body TEXT NOT NULL,
    UNIQUE (site_id, id)
);

CREATE TABLE place_grant (
    site_id TEXT NOT NULL,
    id TEXT NOT NULL,
    revision BIGINT NOT NULL,
    state BIGINT,
    parent TEXT,
    ord BIGINT NOT NULL,
    body TEXT NOT NULL,
    UNIQUE (site_id, id)
);

CREATE TABLE planner_policy (
    site_id TEXT NOT NULL,
    id TEXT NOT NULL,
    revision BIGINT NOT NULL,
    state BIGINT,
    parent TEXT,
    ord BIGINT NOT NULL,
    body TEXT NOT NULL,
    UNIQUE (site_id, id)
);

CREATE TABLE presence (
    site_id TEXT NOT NULL,
    id TEXT NOT NULL,
    revision BIGINT NOT NULL,
    state BIGINT,
    parent TEXT,
    ord BIGINT NOT NULL,
    body TEXT NOT NULL,
    UNIQUE (site_id, id)
);

CREATE TABLE quarantine (
    site_id TEXT NOT NULL,
    id TEXT NOT NULL,
    revision BIGINT NOT NULL,
    state BIGINT,
    parent TEXT,
    ord BIGINT NOT NULL,
    body TEXT NOT NULL,
    UNIQUE (site_id, id)
);

CREATE TABLE request_key (
    site_id TEXT NOT NULL,
    id TEXT NOT NULL,
    revision BIGINT NOT NULL,
    state BIGINT,
    parent TEXT,
    ord BIGINT NOT NULL,
    body TEXT NOT NULL,
    UNIQUE (site_id, id)
);

CREATE TABLE robot_authority (
    site_id TEXT NOT NULL,
    id TEXT NOT NULL,
    revision BIGINT NOT NULL,
    state BIGINT,
    parent TEXT,
    ord BIGINT NOT NULL,
    body TEXT NOT NULL,
    UNIQUE (site_id, id)
);

CREATE TABLE robot_control (
    site_id TEXT NOT NULL,
    id TEXT NOT NULL,
    revision BIGINT NOT NULL,
    state BIGINT,
    parent TEXT,
    ord BIGINT NOT NULL,
    body TEXT NOT NULL,
    UNIQUE (site_id, id)
);

CREATE TABLE robot_counter (
    site_id TEXT NOT NULL,
    id TEXT NOT NULL,
    revision BIGINT NOT NULL,
    state BIGINT,
    parent TEXT,
    ord BIGINT NOT NULL,
    body TEXT NOT NULL,
    UNIQUE (site_id, id)
);

CREATE TABLE robot_identity (
    site_id TEXT NOT NULL,
    id TEXT NOT NULL,
    revision BIGINT NOT NULL,
    state BIGINT,
    parent TEXT,
    ord BIGINT NOT NULL,
    body TEXT NOT NULL,
    UNIQUE (site_id, id)
);

CREATE TABLE robot_inbox (
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
);

CREATE TABLE robot_last (
    site_id TEXT NOT NULL,
    robot_id TEXT NOT NULL,
    position BIGINT NOT NULL,
    session_epoch BIGINT NOT NULL,
    hb BIGINT NOT NULL,
    body TEXT NOT NULL,
    UNIQUE (site_id, robot_id)
);

CREATE TABLE robot_last_head (
    site_id TEXT NOT NULL,
    position BIGINT NOT NULL,
    UNIQUE (site_id)
);

CREATE TABLE robot_software (
    site_id TEXT NOT NULL,
    id TEXT NOT NULL,
    revision BIGINT NOT NULL,
    state BIGINT,
    parent TEXT,
    ord BIGINT NOT NULL,
    body TEXT NOT NULL,
    UNIQUE (site_id, id)
);

CREATE TABLE rollout (
    site_id TEXT NOT NULL,
    id TEXT NOT NULL,
    revision BIGINT NOT NULL,
    state BIGINT,
    parent TEXT,
    ord BIGINT NOT NULL,
    body TEXT NOT NULL,
    UNIQUE (site_id, id)
);

CREATE TABLE rollout_robot (
    site_id TEXT NOT NULL,
    id TEXT NOT NULL,
    revision BIGINT NOT NULL,
    state BIGINT,
    parent TEXT,
    ord BIGINT NOT NULL,
    body TEXT NOT NULL,
    UNIQUE (site_id, id)
);

CREATE TABLE schema_version (version BIGINT NOT NULL, name TEXT NOT NULL, UNIQUE (version));

CREATE TABLE server_certificate (
    site_id TEXT NOT NULL,
    id TEXT NOT NULL,
    revision BIGINT NOT NULL,
    state BIGINT,
    parent TEXT,
    ord BIGINT NOT NULL,
    body TEXT NOT NULL,
    UNIQUE (site_id, id)
);

CREATE TABLE service_clock (
    site_id TEXT NOT NULL,
    id TEXT NOT NULL,
    revision BIGINT NOT NULL,
    state BIGINT,
    parent TEXT,
    ord BIGINT NOT NULL,
    body TEXT NOT NULL,
    UNIQUE (site_id, id)
);

CREATE TABLE session (
    site_id TEXT NOT NULL,
    id TEXT NOT NULL,
    revision BIGINT NOT NULL,
    state BIGINT,
    parent TEXT,
    ord BIGINT NOT NULL,
    body TEXT NOT NULL,
    UNIQUE (site_id, id)
);

CREATE TABLE site (
    site_id TEXT NOT NULL,
    id TEXT NOT NULL,
    revision BIGINT NOT NULL,
    state BIGINT,
    parent TEXT,
    ord BIGINT NOT NULL,
    body TEXT NOT NULL,
    UNIQUE (site_id, id)
);

CREATE TABLE stop_audit (
    site_id TEXT NOT NULL,
    id TEXT NOT NULL,
    revision BIGINT NOT NULL,
    state BIGINT,
    parent TEXT,
    ord BIGINT NOT NULL,
    body TEXT NOT NULL,
    UNIQUE (site_id, id)
);

CREATE TABLE stop_event (
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
);

CREATE TABLE stop_record (
    site_id TEXT NOT NULL,
    id TEXT NOT NULL,
    revision BIGINT NOT NULL,
    state BIGINT,
    parent TEXT,
    ord BIGINT NOT NULL,
    body TEXT NOT NULL,
    UNIQUE (site_id, id)
);

CREATE TABLE store_head (
    site_id TEXT NOT NULL,
    store_id TEXT NOT NULL,
    seq BIGINT NOT NULL,
    UNIQUE (site_id)
);

CREATE TABLE task_audit (
    site_id TEXT NOT NULL,
    id TEXT NOT NULL,
    revision BIGINT NOT NULL,
    state BIGINT,
    parent TEXT,
    ord BIGINT NOT NULL,
    body TEXT NOT NULL,
    UNIQUE (site_id, id)
);

CREATE TABLE task_event (
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
);

CREATE TABLE task_intake (
    site_id TEXT NOT NULL,
    id TEXT NOT NULL,
    revision BIGINT NOT NULL,
    state BIGINT,
    parent TEXT,
    ord BIGINT NOT NULL,
    body TEXT NOT NULL,
    UNIQUE (site_id, id)
);

CREATE TABLE task_request (
    site_id TEXT NOT NULL,
    id TEXT NOT NULL,
    revision BIGINT NOT NULL,
    state BIGINT,
    parent TEXT,
    ord BIGINT NOT NULL,
    body TEXT NOT NULL,
    UNIQUE (site_id, id)
);

CREATE TABLE task_state (
    site_id TEXT NOT NULL,
    id TEXT NOT NULL,
    revision BIGINT NOT NULL,
    state BIGINT,
    parent TEXT,
    ord BIGINT NOT NULL,
    body TEXT NOT NULL,
    UNIQUE (site_id, id)
);

CREATE TABLE task_type (
    site_id TEXT NOT NULL,
    id TEXT NOT NULL,
    revision BIGINT NOT NULL,
    state BIGINT,
    parent TEXT,
    ord BIGINT NOT NULL,
    body TEXT NOT NULL,
    UNIQUE (site_id, id)
);

CREATE TABLE telemetry_event (
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
);

CREATE TABLE timer (
    site_id TEXT NOT NULL,
    id TEXT NOT NULL,
    revision BIGINT NOT NULL,
    state BIGINT,
    parent TEXT,
    ord BIGINT NOT NULL,
    body TEXT NOT NULL,
    UNIQUE (site_id, id)
);

CREATE TABLE token (
    site_id TEXT NOT NULL,
    id TEXT NOT NULL,
    revision BIGINT NOT NULL,
    state BIGINT,
    parent TEXT,
    ord BIGINT NOT NULL,
    body TEXT NOT NULL,
    UNIQUE (site_id, id)
);

CREATE TABLE token_name (
    site_id TEXT NOT NULL,
    id TEXT NOT NULL,
    revision BIGINT NOT NULL,
    state BIGINT,
    parent TEXT,
    ord BIGINT NOT NULL,
    body TEXT NOT NULL,
    UNIQUE (site_id, id)
);

CREATE INDEX attempt_by_parent ON attempt (site_id, parent, ord, id);

CREATE INDEX attempt_by_state ON attempt (site_id, state, ord, id);

CREATE INDEX bundle_by_ord ON bundle (site_id, ord, id);

CREATE INDEX fleet_audit_by_ord ON fleet_audit (site_id, ord, id);

CREATE INDEX fleet_event_by_attempt ON fleet_event (site_id, subject, seq) WHERE tbl = 'attempt';

CREATE INDEX identity_audit_by_ord ON identity_audit (site_id, ord, id);

CREATE INDEX incident_by_ord ON incident (site_id, ord, id);

CREATE INDEX incident_by_state ON incident (site_id, state, ord, id);

CREATE INDEX ota_audit_by_ord ON ota_audit (site_id, ord, id);

CREATE INDEX request_key_by_ord ON request_key (site_id, ord, id);

CREATE INDEX robot_inbox_by_subject ON robot_inbox (site_id, subject, seq);

CREATE INDEX robot_last_by_position ON robot_last (site_id, position);

CREATE INDEX rollout_by_ord ON rollout (site_id, ord, id);

CREATE INDEX rollout_by_state ON rollout (site_id, state, ord, id);

CREATE INDEX rollout_robot_by_parent ON rollout_robot (site_id, parent, ord, id);

CREATE INDEX rollout_robot_by_state ON rollout_robot (site_id, state, ord, id);

CREATE INDEX stop_audit_by_ord ON stop_audit (site_id, ord, id);

CREATE INDEX task_audit_by_ord ON task_audit (site_id, ord, id);

CREATE INDEX task_event_by_request_key ON task_event (site_id, subject, seq) WHERE tbl = 'request_key';

CREATE INDEX task_intake_by_ord ON task_intake (site_id, ord, id);

CREATE INDEX task_request_by_ord ON task_request (site_id, ord, id);

CREATE INDEX task_state_by_ord ON task_state (site_id, ord, id);

CREATE INDEX task_state_by_parent ON task_state (site_id, parent, ord, id);

CREATE INDEX task_state_by_state ON task_state (site_id, state, ord, id);

CREATE INDEX token_by_ord ON token (site_id, ord, id);

