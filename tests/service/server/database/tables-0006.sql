CREATE TABLE jobs (
    id VARCHAR(40) NOT NULL,
    name VARCHAR(255) NOT NULL,
    state VARCHAR(16) NOT NULL,
    priority INTEGER NOT NULL,
    spec JSON NOT NULL,
    figures TEXT,
    image_sha256 VARCHAR(64) NOT NULL,
    image_bytes BIGINT NOT NULL,
    created_by VARCHAR(100) NOT NULL,
    created_at FLOAT NOT NULL,
    queued_at FLOAT NOT NULL,
    started_at FLOAT,
    ended_at FLOAT,
    stage VARCHAR(40),
    progress FLOAT NOT NULL,
    error JSON,
    report JSON,
    cancel_requested BOOLEAN NOT NULL,
    attempt INTEGER NOT NULL,
    owner VARCHAR(100),
    fence INTEGER NOT NULL,
    version INTEGER NOT NULL,
    CONSTRAINT pk_jobs PRIMARY KEY (id)
);
CREATE INDEX ix_jobs_image_sha256 ON jobs (image_sha256);
CREATE INDEX ix_jobs_state_created_at_id ON jobs (state, created_at, id);
CREATE INDEX ix_jobs_owner ON jobs (owner);
CREATE INDEX ix_jobs_state_priority_queued_at_id ON jobs (state, priority, queued_at, id);
CREATE INDEX ix_jobs_ended_at_id ON jobs (ended_at, id);
CREATE INDEX ix_jobs_created_at_id ON jobs (created_at, id);
CREATE TABLE stage_results (
    "key" VARCHAR(64) NOT NULL,
    stage VARCHAR(40) NOT NULL,
    outputs JSON NOT NULL,
    report JSON NOT NULL,
    notes JSON NOT NULL,
    seconds FLOAT NOT NULL,
    peak_rss_mb FLOAT NOT NULL,
    job_id VARCHAR(40) NOT NULL,
    created_at FLOAT NOT NULL,
    used_at FLOAT NOT NULL,
    CONSTRAINT pk_stage_results PRIMARY KEY ("key")
);
CREATE INDEX ix_stage_results_used_at ON stage_results (used_at);
CREATE TABLE idempotency_keys (
    principal VARCHAR(100) NOT NULL,
    kind VARCHAR(16) NOT NULL,
    "key" VARCHAR(200) NOT NULL,
    request_sha256 VARCHAR(64) NOT NULL,
    resource_id VARCHAR(40) NOT NULL,
    created_at FLOAT NOT NULL,
    CONSTRAINT pk_idempotency_keys PRIMARY KEY (principal, kind, "key")
);
CREATE INDEX ix_idempotency_keys_resource_id ON idempotency_keys (resource_id);
CREATE TABLE counters (
    name VARCHAR(40) NOT NULL,
    stage VARCHAR(40) NOT NULL,
    state VARCHAR(16) NOT NULL,
    value FLOAT NOT NULL,
    CONSTRAINT pk_counters PRIMARY KEY (name, stage, state)
);
CREATE TABLE executors (
    id VARCHAR(100) NOT NULL,
    host VARCHAR(255) NOT NULL,
    pid INTEGER NOT NULL,
    boot VARCHAR(40) NOT NULL,
    version VARCHAR(40) NOT NULL,
    started_at FLOAT NOT NULL,
    seen_at FLOAT NOT NULL,
    CONSTRAINT pk_executors PRIMARY KEY (id)
);
CREATE TABLE tokens (
    id VARCHAR(40) NOT NULL,
    name VARCHAR(100) NOT NULL,
    sha256 VARCHAR(64) NOT NULL,
    scopes JSON NOT NULL,
    created_at FLOAT NOT NULL,
    expires_at FLOAT,
    last_used_at FLOAT,
    revoked_at FLOAT,
    paired BOOLEAN DEFAULT 0 NOT NULL,
    CONSTRAINT pk_tokens PRIMARY KEY (id),
    CONSTRAINT uq_tokens_sha256 UNIQUE (sha256)
);
CREATE TABLE pairings (
    id VARCHAR(40) NOT NULL,
    salt VARCHAR(64) NOT NULL,
    digest VARCHAR(64) NOT NULL,
    created_at FLOAT NOT NULL,
    expires_at FLOAT NOT NULL,
    CONSTRAINT pk_pairings PRIMARY KEY (id)
);
CREATE TABLE pairing_tries (
    address VARCHAR(100) NOT NULL,
    used FLOAT NOT NULL,
    at FLOAT NOT NULL,
    CONSTRAINT pk_pairing_tries PRIMARY KEY (address)
);
CREATE TABLE runs (
    id VARCHAR(40) NOT NULL,
    machine VARCHAR(100) NOT NULL,
    job_id VARCHAR(40) NOT NULL,
    program VARCHAR(100) NOT NULL,
    number INTEGER NOT NULL,
    sha256 VARCHAR(64) NOT NULL,
    agent_run VARCHAR(60),
    state VARCHAR(16) NOT NULL,
    open BOOLEAN NOT NULL,
    "view" JSON,
    words VARCHAR(1000),
    reason JSON,
    created_by VARCHAR(100) NOT NULL,
    created_at FLOAT NOT NULL,
    ended_at FLOAT,
    CONSTRAINT pk_runs PRIMARY KEY (id)
);
CREATE INDEX ix_runs_created_at_id ON runs (created_at, id);
CREATE INDEX ix_runs_machine_created_at_id ON runs (machine, created_at, id);
CREATE UNIQUE INDEX uq_runs_open_machine ON runs (machine) WHERE open = 1;
CREATE INDEX ix_runs_job_id_created_at_id ON runs (job_id, created_at, id);
CREATE TABLE stage_runs (
    id INTEGER NOT NULL,
    job_id VARCHAR(40) NOT NULL,
    attempt INTEGER NOT NULL,
    number INTEGER NOT NULL,
    stage VARCHAR(40) NOT NULL,
    state VARCHAR(16) NOT NULL,
    "key" VARCHAR(64) NOT NULL,
    executor VARCHAR(100) NOT NULL,
    fence INTEGER NOT NULL,
    started_at FLOAT NOT NULL,
    ended_at FLOAT,
    peak_rss_mb FLOAT,
    log_sha256 VARCHAR(64),
    words VARCHAR(2000),
    CONSTRAINT pk_stage_runs PRIMARY KEY (id),
    CONSTRAINT fk_stage_runs_job_id FOREIGN KEY(job_id) REFERENCES jobs (id) ON DELETE CASCADE
);
CREATE INDEX ix_stage_runs_job_id ON stage_runs (job_id);
CREATE INDEX ix_stage_runs_log_sha256 ON stage_runs (log_sha256);
CREATE TABLE result_files (
    "key" VARCHAR(64) NOT NULL,
    name VARCHAR(100) NOT NULL,
    sha256 VARCHAR(64) NOT NULL,
    CONSTRAINT pk_result_files PRIMARY KEY ("key", name),
    CONSTRAINT fk_result_files_key FOREIGN KEY("key") REFERENCES stage_results ("key") ON DELETE CASCADE
);
CREATE INDEX ix_result_files_sha256 ON result_files (sha256);
CREATE TABLE artifacts (
    job_id VARCHAR(40) NOT NULL,
    name VARCHAR(100) NOT NULL,
    sha256 VARCHAR(64) NOT NULL,
    bytes BIGINT NOT NULL,
    stage VARCHAR(40) NOT NULL,
    created_at FLOAT NOT NULL,
    CONSTRAINT pk_artifacts PRIMARY KEY (job_id, name),
    CONSTRAINT fk_artifacts_job_id FOREIGN KEY(job_id) REFERENCES jobs (id) ON DELETE CASCADE
);
CREATE INDEX ix_artifacts_sha256 ON artifacts (sha256);
CREATE TABLE events (
    job_id VARCHAR(40) NOT NULL,
    seq INTEGER NOT NULL,
    at FLOAT NOT NULL,
    kind VARCHAR(40) NOT NULL,
    data JSON NOT NULL,
    CONSTRAINT pk_events PRIMARY KEY (job_id, seq),
    CONSTRAINT fk_events_job_id FOREIGN KEY(job_id) REFERENCES jobs (id) ON DELETE CASCADE
);
CREATE TABLE progress (
    job_id VARCHAR(40) NOT NULL,
    stage VARCHAR(40) NOT NULL,
    share FLOAT NOT NULL,
    at FLOAT NOT NULL,
    CONSTRAINT pk_progress PRIMARY KEY (job_id),
    CONSTRAINT fk_progress_job_id FOREIGN KEY(job_id) REFERENCES jobs (id) ON DELETE CASCADE
);
CREATE TABLE alembic_version (
    version_num VARCHAR(32) NOT NULL,
    CONSTRAINT alembic_version_pkc PRIMARY KEY (version_num)
);
INSERT INTO alembic_version VALUES ('0006');
