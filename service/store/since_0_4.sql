-- What came after release 0.4.

CREATE TABLE selections (           -- sets of splats that somebody corrects; they belong to whom their lift does
    id TEXT PRIMARY KEY,
    lift TEXT NOT NULL REFERENCES lifts (id) ON DELETE CASCADE,
    name TEXT NOT NULL,
    version INTEGER NOT NULL,       -- grows with each change: the entity tag
    step INTEGER NOT NULL,          -- of its history, where it is
    created REAL NOT NULL,
    changed REAL NOT NULL
) STRICT;
CREATE INDEX selections_of_lift ON selections (lift, created DESC, id);

CREATE TABLE selection_steps (
    selection TEXT NOT NULL REFERENCES selections (id) ON DELETE CASCADE,
    number INTEGER NOT NULL,        -- ascending
    edit TEXT NOT NULL,             -- JSON: what made it of the step before
    count INTEGER NOT NULL,
    box TEXT,                       -- JSON
    splats BLOB NOT NULL,           -- zlib of a bit a splat, the first the lowest of its byte
    PRIMARY KEY (selection, number)
) STRICT;

CREATE TABLE things (               -- what people call the objects of a lift
    lift TEXT NOT NULL REFERENCES lifts (id) ON DELETE CASCADE,
    thing INTEGER NOT NULL,
    name TEXT,
    hidden INTEGER NOT NULL,
    PRIMARY KEY (lift, thing)
) STRICT, WITHOUT ROWID;

-- Keys to given lifts; such a key ends with its maker, another key.

ALTER TABLE keys ADD COLUMN maker TEXT REFERENCES keys (id);

CREATE TABLE key_lifts (            -- what a key of the scope `shared` is given; without a row it sees nothing
    key TEXT NOT NULL REFERENCES keys (id) ON DELETE CASCADE,
    lift TEXT NOT NULL REFERENCES lifts (id) ON DELETE CASCADE,
    PRIMARY KEY (key, lift)
) STRICT, WITHOUT ROWID;
CREATE INDEX key_lifts_by_lift ON key_lifts (lift);
