PRAGMA user_version = 13;
BEGIN TRANSACTION;
CREATE TABLE asset_names (          -- of views, or the words of a table: a page of them is a range of rows
    asset TEXT NOT NULL REFERENCES assets (id) ON DELETE CASCADE,
    place INTEGER NOT NULL,
    name TEXT NOT NULL,
    PRIMARY KEY (asset, place)
) STRICT, WITHOUT ROWID;
INSERT INTO "asset_names" VALUES('c',0,'w');
INSERT INTO "asset_names" VALUES('c',1,'v');
INSERT INTO "asset_names" VALUES('t',0,'apple');
CREATE TABLE asset_owners (         -- two who uploaded the same bytes both have them
    asset TEXT NOT NULL REFERENCES assets (id) ON DELETE CASCADE,
    owner TEXT NOT NULL,            -- the id of a key; '' = made while there was none: of admins alone
    created REAL NOT NULL,
    PRIMARY KEY (asset, owner)
) STRICT, WITHOUT ROWID;
INSERT INTO "asset_owners" VALUES('c','',0.0);
INSERT INTO "asset_owners" VALUES('f','',0.0);
INSERT INTO "asset_owners" VALUES('s','',0.0);
INSERT INTO "asset_owners" VALUES('t','',0.0);
CREATE TABLE assets (
    id TEXT PRIMARY KEY,            -- sha256:...
    kind TEXT NOT NULL,             -- splats, cameras, features
    bytes INTEGER NOT NULL,
    file TEXT NOT NULL,             -- path below the data directory
    counts TEXT NOT NULL,           -- JSON
    warnings TEXT NOT NULL, counts_bytes INTEGER NOT NULL DEFAULT 0) STRICT;
INSERT INTO "assets" VALUES('s','splats',1,'blobs/x','{}','[]',30);
INSERT INTO "assets" VALUES('c','cameras',1,'blobs/x','{"views": 2}','[]',30);
INSERT INTO "assets" VALUES('f','features',1,'blobs/x','{}','[]',30);
INSERT INTO "assets" VALUES('t','table',1,'blobs/x','{"channels": 1}','[]',30);
CREATE TABLE generation (           -- one row: how many transactions were counted, as the data directory knows too
    number INTEGER NOT NULL
) STRICT;
INSERT INTO "generation" VALUES(7);
CREATE TABLE job_events (
    job TEXT NOT NULL REFERENCES jobs (id) ON DELETE CASCADE,
    number INTEGER NOT NULL,        -- ascending in a job; never given twice
    kind TEXT NOT NULL,             -- state, progress, log
    data TEXT NOT NULL,             -- JSON
    created REAL NOT NULL,
    PRIMARY KEY (job, number)
) STRICT, WITHOUT ROWID;
INSERT INTO "job_events" VALUES('a',1,'state','{"state": "running", "attempt": 1, "problem": null}',0.0);
INSERT INTO "job_events" VALUES('b',1,'state','{"state": "queued", "attempt": 1, "problem": null}',0.0);
INSERT INTO "job_events" VALUES('c',1,'state','{"state": "failed", "attempt": 1, "problem": {"kind": "crashed", "argument": "job", "expected": "a", "got": "b", "hint": ""}}',0.0);
INSERT INTO "job_events" VALUES('d',1,'state','{"state": "succeeded", "attempt": 1, "problem": null}',0.0);
CREATE TABLE job_features (
    job TEXT NOT NULL REFERENCES jobs (id) ON DELETE CASCADE,
    place INTEGER NOT NULL,
    asset TEXT NOT NULL REFERENCES assets (id),
    PRIMARY KEY (job, place)
) STRICT;
INSERT INTO "job_features" VALUES('a',0,'f');
INSERT INTO "job_features" VALUES('b',0,'f');
INSERT INTO "job_features" VALUES('c',0,'f');
INSERT INTO "job_features" VALUES('d',0,'f');
CREATE TABLE job_labels (           -- what the labels of a job's parameters name, so that it stays as long as the job
    job TEXT NOT NULL REFERENCES jobs (id) ON DELETE CASCADE,
    asset TEXT NOT NULL REFERENCES assets (id),
    PRIMARY KEY (job, asset)
) STRICT, WITHOUT ROWID;
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
, leased_until REAL, idempotency_key TEXT, fingerprint TEXT, request_id TEXT, owner TEXT NOT NULL DEFAULT '', kind TEXT NOT NULL DEFAULT 'lift', parameters TEXT NOT NULL DEFAULT '{}', plan TEXT) STRICT;
INSERT INTO "jobs" VALUES('a','running',1,0,'s','c','{}',NULL,NULL,0.0,NULL,NULL,NULL,NULL,NULL,NULL,'','lift','{}',NULL);
INSERT INTO "jobs" VALUES('b','queued',1,0,'s','c','{}',NULL,NULL,0.0,NULL,NULL,NULL,NULL,NULL,NULL,'','lift','{}',NULL);
INSERT INTO "jobs" VALUES('c','failed',1,0,'s','c','{}',NULL,'{"kind": "crashed", "argument": "job", "expected": "a", "got": "b", "hint": ""}',0.0,NULL,NULL,NULL,NULL,NULL,NULL,'','lift','{}',NULL);
INSERT INTO "jobs" VALUES('d','succeeded',1,0,'s','c','{}',NULL,NULL,0.0,NULL,NULL,NULL,NULL,NULL,NULL,'','lift','{}',NULL);
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
, expires REAL, old_digest TEXT, old_until REAL) STRICT;
INSERT INTO "keys" VALUES('k','anna','x','read write',NULL,NULL,NULL,0.0,NULL,NULL,NULL,NULL);
CREATE TABLE lifted_views (
    lift TEXT NOT NULL REFERENCES lifts (id) ON DELETE CASCADE,
    name TEXT NOT NULL,
    PRIMARY KEY (lift, name)
) STRICT, WITHOUT ROWID;
INSERT INTO "lifted_views" VALUES('d','v');
CREATE TABLE lifts (
    id TEXT PRIMARY KEY REFERENCES jobs (id),
    bytes INTEGER NOT NULL,
    sha256 TEXT NOT NULL,
    file TEXT NOT NULL,             -- path below the data directory
    count INTEGER NOT NULL,
    channels INTEGER NOT NULL,
    metadata TEXT NOT NULL,         -- JSON, as in the lift file
    created REAL NOT NULL
, view_count INTEGER NOT NULL DEFAULT 0, first_view TEXT, name TEXT, photos TEXT REFERENCES assets (id)) STRICT;
INSERT INTO "lifts" VALUES('d',1,'d','lifts/d',1,1,'{"views": ["v"]}',0.0,1,'v','the desk',NULL);
CREATE TABLE tradeoffs (            -- small enough to lie here, so that no file can be without its row
    id TEXT PRIMARY KEY REFERENCES jobs (id),
    bytes INTEGER NOT NULL,
    document TEXT NOT NULL,         -- JSON, as liftcore.evaluate.tradeoff.compare gives it
    page TEXT NOT NULL,             -- Markdown
    chart BLOB NOT NULL,            -- PNG
    sha256 TEXT NOT NULL,           -- of the chart
    created REAL NOT NULL
) STRICT;
CREATE INDEX jobs_in_line ON jobs (state, created);
CREATE INDEX job_features_of_asset ON job_features (asset);
CREATE INDEX asset_owners_by_owner ON asset_owners (owner);
CREATE UNIQUE INDEX jobs_by_key ON jobs (owner, idempotency_key);
CREATE INDEX job_labels_of_asset ON job_labels (asset);
CREATE INDEX jobs_by_age ON jobs (created DESC, id);
CREATE INDEX lifts_by_age ON lifts (created DESC, id);
CREATE INDEX lifts_by_photos ON lifts (photos);
CREATE INDEX lifts_by_digest ON lifts (sha256);
COMMIT;
