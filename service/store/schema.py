"""The schema of the database, as the steps that lead to it. A step that was released is never changed."""

from __future__ import annotations

# MIGRATIONS[n] leads from version n to n + 1; the version is SQLite's user_version.
MIGRATIONS = (
    """
CREATE TABLE assets (
    id TEXT PRIMARY KEY,            -- sha256:...
    kind TEXT NOT NULL,             -- splats, cameras, features
    bytes INTEGER NOT NULL,
    file TEXT NOT NULL,             -- path below the data directory
    counts TEXT NOT NULL,           -- JSON
    warnings TEXT NOT NULL,         -- JSON
    created REAL NOT NULL
) STRICT;

CREATE TABLE jobs (
    id TEXT PRIMARY KEY,
    state TEXT NOT NULL,            -- as service.models.JobState
    attempt INTEGER NOT NULL DEFAULT 0,
    released INTEGER NOT NULL DEFAULT 0,  -- attempts that ended with an orderly stop of the server
    splats TEXT NOT NULL REFERENCES assets (id),
    cameras TEXT NOT NULL REFERENCES assets (id),
    settings TEXT NOT NULL,         -- JSON
    progress TEXT,                  -- JSON
    problem TEXT,                   -- JSON: kind, argument, expected, got, hint
    created REAL NOT NULL,
    started REAL,
    ended REAL
) STRICT;
CREATE INDEX jobs_in_line ON jobs (state, created);

CREATE TABLE job_features (
    job TEXT NOT NULL REFERENCES jobs (id) ON DELETE CASCADE,
    place INTEGER NOT NULL,
    asset TEXT NOT NULL REFERENCES assets (id),
    PRIMARY KEY (job, place)
) STRICT;
CREATE INDEX job_features_of_asset ON job_features (asset);

CREATE TABLE lifts (
    id TEXT PRIMARY KEY REFERENCES jobs (id),
    bytes INTEGER NOT NULL,
    sha256 TEXT NOT NULL,
    file TEXT NOT NULL,             -- path below the data directory
    count INTEGER NOT NULL,
    channels INTEGER NOT NULL,
    metadata TEXT NOT NULL,         -- JSON, as in the lift file
    created REAL NOT NULL
) STRICT;
""",
    """
ALTER TABLE jobs ADD COLUMN leased_until REAL;      -- a running attempt is lost when it is silent until then
ALTER TABLE jobs ADD COLUMN idempotency_key TEXT;   -- as the client sent it
ALTER TABLE jobs ADD COLUMN fingerprint TEXT;       -- sha256 of the order that came with the key
CREATE UNIQUE INDEX jobs_by_key ON jobs (idempotency_key);

CREATE TABLE job_events (
    job TEXT NOT NULL REFERENCES jobs (id) ON DELETE CASCADE,
    number INTEGER NOT NULL,        -- ascending in a job; never given twice
    kind TEXT NOT NULL,             -- state, progress, log
    data TEXT NOT NULL,             -- JSON
    created REAL NOT NULL,
    PRIMARY KEY (job, number)
) STRICT, WITHOUT ROWID;
INSERT INTO job_events
    SELECT id, 1, 'state',
        json_object('state', state, 'attempt', attempt, 'problem', json(coalesce(problem, 'null'))), created
    FROM jobs;
""",
    """
ALTER TABLE jobs ADD COLUMN request_id TEXT;        -- X-Request-ID of the request that made it
""",
    """
CREATE TABLE keys (
    id TEXT PRIMARY KEY,
    name TEXT NOT NULL,
    digest TEXT NOT NULL UNIQUE,    -- sha256 of the secret in hex; the secret itself is nowhere
    scopes TEXT NOT NULL,           -- as service.scopes.Scope, with spaces between
    max_bytes INTEGER,              -- what is not set is as the server's settings have it
    max_queued INTEGER,
    max_uploads INTEGER,
    created REAL NOT NULL,
    revoked REAL                    -- a revoked key stays: that there was one closes the service for good
) STRICT;

CREATE TABLE asset_owners (         -- two who uploaded the same bytes both have them
    asset TEXT NOT NULL REFERENCES assets (id) ON DELETE CASCADE,
    owner TEXT NOT NULL,            -- the id of a key; '' = made while there was none: of admins alone
    created REAL NOT NULL,
    PRIMARY KEY (asset, owner)
) STRICT, WITHOUT ROWID;
INSERT INTO asset_owners SELECT id, '', created FROM assets;
CREATE INDEX asset_owners_by_owner ON asset_owners (owner);
ALTER TABLE assets DROP COLUMN created;

ALTER TABLE jobs ADD COLUMN owner TEXT NOT NULL DEFAULT '';  -- likewise
DROP INDEX jobs_by_key;
CREATE UNIQUE INDEX jobs_by_key ON jobs (owner, idempotency_key);
""",
    """
ALTER TABLE jobs ADD COLUMN kind TEXT NOT NULL DEFAULT 'lift';      -- as service.models.JobKind
ALTER TABLE jobs ADD COLUMN parameters TEXT NOT NULL DEFAULT '{}';  -- JSON: what its kind takes beside settings

CREATE TABLE tradeoffs (            -- small enough to lie here, so that no file can be without its row
    id TEXT PRIMARY KEY REFERENCES jobs (id),
    bytes INTEGER NOT NULL,
    document TEXT NOT NULL,         -- JSON, as liftcore.evaluate.tradeoff.compare gives it
    page TEXT NOT NULL,             -- Markdown
    chart BLOB NOT NULL,            -- PNG
    sha256 TEXT NOT NULL,           -- of the chart
    created REAL NOT NULL
) STRICT;
""",
    """
CREATE TABLE job_labels (           -- what the labels of a job's parameters name, so that it stays as long as the job
    job TEXT NOT NULL REFERENCES jobs (id) ON DELETE CASCADE,
    asset TEXT NOT NULL REFERENCES assets (id),
    PRIMARY KEY (job, asset)
) STRICT, WITHOUT ROWID;
CREATE INDEX job_labels_of_asset ON job_labels (asset);
""",
    """
ALTER TABLE jobs ADD COLUMN plan TEXT;              -- JSON: what the latest attempt that planned set out to do
""",
    """
CREATE TABLE generation (           -- one row: how many transactions were counted, as the data directory knows too
    number INTEGER NOT NULL
) STRICT;
INSERT INTO generation VALUES (0);
""",
    """
CREATE INDEX jobs_by_age ON jobs (created DESC, id);    -- lists are read in pages
CREATE INDEX lifts_by_age ON lifts (created DESC, id);

ALTER TABLE assets ADD COLUMN brief TEXT NOT NULL DEFAULT '{}';  -- counts without names and words: these may be 49 MB
ALTER TABLE assets ADD COLUMN counts_bytes INTEGER NOT NULL DEFAULT 0;
UPDATE assets SET brief = json_remove(counts, '$.names', '$.words'), counts_bytes = length(counts);
""",
    """
ALTER TABLE keys ADD COLUMN expires REAL;
ALTER TABLE keys ADD COLUMN old_digest TEXT;        -- of the secret before a rotation, which counts
ALTER TABLE keys ADD COLUMN old_until REAL;         -- until then
""",
    """
ALTER TABLE lifts ADD COLUMN brief TEXT NOT NULL DEFAULT '{}';   -- metadata without names of views: likewise
ALTER TABLE lifts ADD COLUMN metadata_bytes INTEGER NOT NULL DEFAULT 0;
ALTER TABLE lifts ADD COLUMN view_count INTEGER NOT NULL DEFAULT 0;
ALTER TABLE lifts ADD COLUMN first_view TEXT;
UPDATE lifts SET metadata_bytes = length(metadata), view_count = coalesce(json_array_length(metadata, '$.views'), 0),
    first_view = json_extract(metadata, '$.views[0]'), brief = json_remove(metadata, '$.views',
    '$.certificate.views_without_camera', '$.certificate.views_without_splats');
""",
    """
ALTER TABLE lifts ADD COLUMN name TEXT;             -- that somebody gave it
ALTER TABLE lifts ADD COLUMN photos TEXT REFERENCES assets (id);
CREATE INDEX lifts_by_photos ON lifts (photos);
CREATE INDEX lifts_by_digest ON lifts (sha256);
""",
    # A hundred thousand names in one value were 49 MB, through which SQLite walks to every column after it.
    """
CREATE TABLE asset_names (          -- of views, or the words of a table: a page of them is a range of rows
    asset TEXT NOT NULL REFERENCES assets (id) ON DELETE CASCADE,
    place INTEGER NOT NULL,
    name TEXT NOT NULL,
    PRIMARY KEY (asset, place)
) STRICT, WITHOUT ROWID;
INSERT INTO asset_names
    SELECT assets.id, key, value FROM assets,
        json_each(counts, iif(json_type(counts, '$.words') IS NULL, '$.names', '$.words'));
UPDATE assets SET counts = brief;
ALTER TABLE assets DROP COLUMN brief;

CREATE TABLE lifted_views (
    lift TEXT NOT NULL REFERENCES lifts (id) ON DELETE CASCADE,
    name TEXT NOT NULL,
    PRIMARY KEY (lift, name)
) STRICT, WITHOUT ROWID;
INSERT OR IGNORE INTO lifted_views SELECT lifts.id, value FROM lifts, json_each(metadata, '$.views');
UPDATE lifts SET metadata = brief WHERE metadata_bytes > 65536;
ALTER TABLE lifts DROP COLUMN brief;
ALTER TABLE lifts DROP COLUMN metadata_bytes;
""",
)
