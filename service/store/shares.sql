-- What came with keys to given lifts. A key ends with its maker, another key.

ALTER TABLE keys ADD COLUMN maker TEXT REFERENCES keys (id);

CREATE TABLE key_lifts (            -- what a key of the scope `shared` is given; without a row it sees nothing
    key TEXT NOT NULL REFERENCES keys (id) ON DELETE CASCADE,
    lift TEXT NOT NULL REFERENCES lifts (id) ON DELETE CASCADE,
    PRIMARY KEY (key, lift)
) STRICT, WITHOUT ROWID;
CREATE INDEX key_lifts_by_lift ON key_lifts (lift);
