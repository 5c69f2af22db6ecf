-- The tables of release 0.4. Statements end with a semicolon at the end of a line, and no comment does.

CREATE TABLE assets (
    id TEXT PRIMARY KEY,            -- sha256:...
    kind TEXT NOT NULL,             -- as service.models.AssetKind
    bytes INTEGER NOT NULL,
    file TEXT NOT NULL,             -- path below the data directory
    counts TEXT NOT NULL,           -- JSON, without names and words
    warnings TEXT NOT NULL,         -- JSON
    counts_bytes INTEGER NOT NULL DEFAULT 0  -- with names and words
) STRICT;

CREATE TABLE asset_names (          -- of views, or the words of a table: a page of them is a range of rows
    asset TEXT NOT NULL REFERENCES assets (id) ON DELETE CASCADE,
    place INTEGER NOT NULL,
    name TEXT NOT NULL,
    PRIMARY KEY (asset, place)
) STRICT, WITHOUT ROWID;

CREATE TABLE asset_owners (         -- two who uploaded the same bytes both have them
    asset TEXT NOT NULL REFERENCES assets (id) ON DELETE CASCADE,
    owner TEXT NOT NULL,            -- the id of a key; '' = made while there was none: of admins alone
    created REAL NOT NULL,
    PRIMARY KEY (asset, owner)
) STRICT, WITHOUT ROWID;
CREATE INDEX asset_owners_by_owner ON asset_owners (owner);

CREATE TABLE jobs (
    id TEXT PRIMARY KEY,
    owner TEXT NOT NULL DEFAULT '', -- likewise
    kind TEXT NOT NULL DEFAULT 'lift',  -- as service.models.JobKind
    state TEXT NOT NULL,            -- as service.models.JobState
    attempt INTEGER NOT NULL DEFAULT 0,
    released INTEGER NOT NULL DEFAULT 0,  -- attempts that ended with an orderly stop of the server
    leased_until REAL,              -- a running attempt is lost when it is silent until then
    splats TEXT NOT NULL REFERENCES assets (id),
    cameras TEXT NOT NULL REFERENCES assets (id),
    settings TEXT NOT NULL,         -- JSON
    parameters TEXT NOT NULL DEFAULT '{}',  -- JSON: what its kind takes beside settings
    plan TEXT,                      -- JSON: what the latest attempt that planned set out to do
    progress TEXT,                  -- JSON
    problem TEXT,                   -- JSON: kind, argument, expected, got, hint
    idempotency_key TEXT,           -- as the client sent it
    fingerprint TEXT,               -- sha256 of the order that came with the key
    request_id TEXT,                -- X-Request-ID of the request that made it
    created REAL NOT NULL,
    started REAL,
    ended REAL
) STRICT;
CREATE INDEX jobs_in_line ON jobs (state, created);
CREATE UNIQUE INDEX jobs_by_key ON jobs (owner, idempotency_key);
CREATE INDEX jobs_by_age ON jobs (created DESC, id);

CREATE TABLE job_features (
    job TEXT NOT NULL REFERENCES jobs (id) ON DELETE CASCADE,
    place INTEGER NOT NULL,
    asset TEXT NOT NULL REFERENCES assets (id),
    PRIMARY KEY (job, place)
) STRICT;
CREATE INDEX job_features_of_asset ON job_features (asset);

CREATE TABLE job_labels (           -- what the labels of a job's parameters name, so that it stays as long as the job
    job TEXT NOT NULL REFERENCES jobs (id) ON DELETE CASCADE,
    asset TEXT NOT NULL REFERENCES assets (id),
    PRIMARY KEY (job, asset)
) STRICT, WITHOUT ROWID;
CREATE INDEX job_labels_of_asset ON job_labels (asset);

CREATE TABLE job_events (
    job TEXT NOT NULL REFERENCES jobs (id) ON DELETE CASCADE,
    number INTEGER NOT NULL,        -- ascending in a job; never given twice
    kind TEXT NOT NULL,             -- as service.store.jobs.EventKind
    data TEXT NOT NULL,             -- JSON
    created REAL NOT NULL,
    PRIMARY KEY (job, number)
) STRICT, WITHOUT ROWID;

CREATE TABLE lifts (
    id TEXT PRIMARY KEY REFERENCES jobs (id),
    name TEXT,                      -- that somebody gave it
    photos TEXT REFERENCES assets (id),
    bytes INTEGER NOT NULL,
    sha256 TEXT NOT NULL,
    file TEXT NOT NULL,             -- path below the data directory
    count INTEGER NOT NULL,
    channels INTEGER NOT NULL,
    view_count INTEGER NOT NULL DEFAULT 0,
    first_view TEXT,
    metadata TEXT NOT NULL,         -- JSON, as in the lift file; of many views without their names
    created REAL NOT NULL
) STRICT;
CREATE INDEX lifts_by_age ON lifts (created DESC, id);
CREATE INDEX lifts_by_photos ON lifts (photos);
CREATE INDEX lifts_by_digest ON lifts (sha256);

CREATE TABLE lifted_views (
    lift TEXT NOT NULL REFERENCES lifts (id) ON DELETE CASCADE,
    name TEXT NOT NULL,
    PRIMARY KEY (lift, name)
) STRICT, WITHOUT ROWID;

CREATE TABLE tradeoffs (            -- small enough to lie here, so that no file can be without its row
    id TEXT PRIMARY KEY REFERENCES jobs (id),
    bytes INTEGER NOT NULL,
    document TEXT NOT NULL,         -- JSON, as liftcore.evaluate.tradeoff.compare gives it
    page TEXT NOT NULL,             -- Markdown
    chart BLOB NOT NULL,            -- PNG
    sha256 TEXT NOT NULL,           -- of the chart
    created REAL NOT NULL
) STRICT;

CREATE TABLE keys (
    id TEXT PRIMARY KEY,
    name TEXT NOT NULL,
    digest TEXT NOT NULL UNIQUE,    -- sha256 of the secret in hex; the secret itself is nowhere
    old_digest TEXT,                -- of the secret before a rotation, which counts
    old_until REAL,                 -- until then
    scopes TEXT NOT NULL,           -- as service.store.owners.Scope, with spaces between
    max_bytes INTEGER,              -- what is not set is as the server's settings have it
    max_queued INTEGER,
    max_uploads INTEGER,
    created REAL NOT NULL,
    expires REAL,
    revoked REAL                    -- a revoked key stays: that there was one closes the service for good
) STRICT;

CREATE TABLE generation (           -- one row: how many transactions were counted, as the data directory knows too
    number INTEGER NOT NULL
) STRICT;
INSERT INTO generation VALUES (0);
