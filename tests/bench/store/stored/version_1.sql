BEGIN TRANSACTION;
CREATE TABLE calibrations (
	id INTEGER NOT NULL, 
	bench VARCHAR NOT NULL, 
	kind VARCHAR NOT NULL, 
	version INTEGER NOT NULL, 
	subject VARCHAR NOT NULL, 
	date DATETIME NOT NULL, 
	expires DATETIME NOT NULL, 
	"by" VARCHAR NOT NULL, 
	method VARCHAR NOT NULL, 
	note VARCHAR NOT NULL, 
	content JSON NOT NULL, 
	PRIMARY KEY (id), 
	UNIQUE (bench, kind, version)
);
INSERT INTO "calibrations" VALUES(1,'bench1','encoders',1,'','2026-11-21 12:00:00.000000','2027-02-19 12:00:00.000000','A. Person','rule','','{"zero_count": [1.0, 2.0, 3.0]}');
CREATE TABLE schema_version (
	version INTEGER NOT NULL, 
	date DATETIME NOT NULL, 
	PRIMARY KEY (version)
);
INSERT INTO "schema_version" VALUES(1,'2026-11-21 12:00:00.000000');
CREATE TRIGGER calibrations_no_update BEFORE UPDATE ON calibrations BEGIN SELECT RAISE(ABORT, 'calibrations are only added'); END;
CREATE TRIGGER calibrations_no_delete BEFORE DELETE ON calibrations BEGIN SELECT RAISE(ABORT, 'calibrations are only added'); END;
COMMIT;
