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
