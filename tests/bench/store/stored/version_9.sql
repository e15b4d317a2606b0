BEGIN TRANSACTION;
CREATE TABLE air_readings (
	id INTEGER NOT NULL, 
	bench VARCHAR NOT NULL, 
	date DATETIME NOT NULL, 
	temperature DOUBLE NOT NULL, 
	pressure DOUBLE NOT NULL, 
	relative_humidity DOUBLE NOT NULL, 
	"by" VARCHAR NOT NULL, 
	PRIMARY KEY (id)
);
INSERT INTO "air_readings" VALUES(1,'bench1','2026-11-21 12:00:00.000000',295.15,100800.0,0.4,'Ann');
CREATE TABLE ball_aerodynamics (
	id INTEGER NOT NULL, 
	bench VARCHAR NOT NULL, 
	ball VARCHAR NOT NULL, 
	version INTEGER NOT NULL, 
	date DATETIME NOT NULL, 
	source VARCHAR NOT NULL, 
	"by" VARCHAR NOT NULL, 
	content JSON NOT NULL, 
	PRIMARY KEY (id), 
	UNIQUE (bench, ball, version)
);
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
CREATE TABLE campaign_events (
	id INTEGER NOT NULL, 
	campaign VARCHAR NOT NULL, 
	date DATETIME NOT NULL, 
	before_shot INTEGER NOT NULL, 
	kind VARCHAR NOT NULL, 
	text VARCHAR NOT NULL, 
	PRIMARY KEY (id), 
	FOREIGN KEY(campaign) REFERENCES campaigns (id)
);
INSERT INTO "campaign_events" VALUES(1,'two-20261121T120000','2026-11-21 12:00:00.000000',1,'guard','guard opened');
CREATE TABLE campaign_prompts (
	campaign VARCHAR NOT NULL, 
	number INTEGER NOT NULL, 
	before_shot INTEGER NOT NULL, 
	kind VARCHAR NOT NULL, 
	text VARCHAR NOT NULL, 
	content JSON NOT NULL, 
	asked DATETIME NOT NULL, 
	answered DATETIME, 
	"by" VARCHAR NOT NULL, answer INTEGER DEFAULT '0' NOT NULL, 
	PRIMARY KEY (campaign, number), 
	FOREIGN KEY(campaign) REFERENCES campaigns (id)
);
INSERT INTO "campaign_prompts" VALUES('two-20261121T120000',1,1,'club','Mount club driver.','{"club": "driver"}','2026-11-21 12:00:00.000000','2026-11-21 12:00:00.000000','Ann',1);
INSERT INTO "campaign_prompts" VALUES('two-20261121T120000',2,3,'club','Mount club iron.','{"club": "iron"}','2026-11-21 12:00:00.000000',NULL,'',0);
CREATE TABLE campaign_runs (
	campaign VARCHAR NOT NULL, 
	number INTEGER NOT NULL, 
	began DATETIME NOT NULL, 
	"by" VARCHAR NOT NULL, 
	versions JSON NOT NULL, 
	facts JSON NOT NULL, 
	PRIMARY KEY (campaign, number), 
	FOREIGN KEY(campaign) REFERENCES campaigns (id)
);
CREATE TABLE campaigns (
	id VARCHAR NOT NULL, 
	bench VARCHAR NOT NULL, 
	name VARCHAR NOT NULL, 
	title VARCHAR NOT NULL, 
	date DATETIME NOT NULL, 
	simulated BOOLEAN NOT NULL, 
	state VARCHAR NOT NULL, 
	reason VARCHAR NOT NULL, 
	requested VARCHAR NOT NULL, 
	seed INTEGER NOT NULL, 
	"plan" JSON NOT NULL, 
	digest VARCHAR NOT NULL, 
	configuration JSON NOT NULL, 
	versions JSON NOT NULL, 
	real_time JSON NOT NULL, 
	calibrations JSON NOT NULL, number INTEGER DEFAULT '0' NOT NULL, 
	PRIMARY KEY (id)
);
INSERT INTO "campaigns" VALUES('two-20261121T120000','bench1','two','Two','2026-11-21 12:00:00.000000',1,'finished','','',7,'{"design": {"blocks": 3}}','0123456789abcdef','{"loop": {"rate": 1000.0}}','{"golfbench": "0.1.0"}','{}','{}',1);
CREATE TABLE hit_counts (
	scope VARCHAR NOT NULL, 
	kind VARCHAR NOT NULL, 
	name VARCHAR NOT NULL, 
	sample INTEGER NOT NULL, 
	hits INTEGER NOT NULL, 
	PRIMARY KEY (scope, kind, name, sample)
);
INSERT INTO "hit_counts" VALUES('two-20261121T120000','ball','tour',3,2);
CREATE TABLE learned_swings (
	id INTEGER NOT NULL, 
	bench VARCHAR NOT NULL, 
	profile VARCHAR NOT NULL, 
	version INTEGER NOT NULL, 
	date DATETIME NOT NULL, 
	simulated BOOLEAN NOT NULL, 
	source VARCHAR NOT NULL, 
	digest VARCHAR NOT NULL, 
	club VARCHAR NOT NULL, 
	supply_pressure DOUBLE NOT NULL, 
	temperature DOUBLE NOT NULL, 
	within BOOLEAN NOT NULL, 
	content JSON NOT NULL, 
	PRIMARY KEY (id), 
	UNIQUE (bench, profile, version)
);
CREATE TABLE schema_version (
	version INTEGER NOT NULL, 
	date DATETIME NOT NULL, 
	PRIMARY KEY (version)
);
INSERT INTO "schema_version" VALUES(8,'2026-11-21 12:00:00.000000');
INSERT INTO "schema_version" VALUES(9,'2026-11-21 12:00:00.000000');
CREATE TABLE shot_exclusions (
	id INTEGER NOT NULL, 
	campaign VARCHAR NOT NULL, 
	shot INTEGER NOT NULL, 
	date DATETIME NOT NULL, 
	"by" VARCHAR NOT NULL, 
	reason VARCHAR NOT NULL, 
	excluded BOOLEAN NOT NULL, 
	after_shot INTEGER NOT NULL, 
	PRIMARY KEY (id), 
	FOREIGN KEY(campaign) REFERENCES campaigns (id)
);
CREATE TABLE shot_notes (
	id INTEGER NOT NULL, 
	campaign VARCHAR NOT NULL, 
	shot INTEGER NOT NULL, 
	date DATETIME NOT NULL, 
	"by" VARCHAR NOT NULL, 
	text VARCHAR NOT NULL, 
	PRIMARY KEY (id), 
	FOREIGN KEY(campaign) REFERENCES campaigns (id)
);
CREATE TABLE shots (
	campaign VARCHAR NOT NULL, 
	shot INTEGER NOT NULL, 
	block INTEGER NOT NULL, 
	position INTEGER NOT NULL, 
	club VARCHAR NOT NULL, 
	ball VARCHAR NOT NULL, 
	status VARCHAR NOT NULL, 
	reason VARCHAR NOT NULL, 
	club_speed_mps DOUBLE, 
	attack_angle_deg DOUBLE, 
	club_path_deg DOUBLE, 
	face_angle_deg DOUBLE, 
	dynamic_loft_deg DOUBLE, 
	strike_x_mm DOUBLE, 
	strike_y_mm DOUBLE, 
	ball_speed_mps DOUBLE, 
	launch_angle_deg DOUBLE, 
	direction_deg DOUBLE, 
	spin_rpm DOUBLE, 
	spin_axis_deg DOUBLE, 
	carry_m DOUBLE, 
	total_m DOUBLE, 
	apex_m DOUBLE, 
	landing_angle_deg DOUBLE, 
	delivery_source VARCHAR NOT NULL, 
	launch_source VARCHAR NOT NULL, 
	carry_source VARCHAR NOT NULL, 
	time_utc DATETIME NOT NULL, 
	carry_side_m DOUBLE, 
	swing VARCHAR NOT NULL, 
	role VARCHAR NOT NULL, 
	section INTEGER NOT NULL, 
	attempt INTEGER NOT NULL, 
	sample INTEGER NOT NULL, 
	air_temperature_k DOUBLE, 
	air_pressure_pa DOUBLE, 
	relative_humidity DOUBLE, 
	file VARCHAR NOT NULL, 
	bytes INTEGER NOT NULL, carry_reference_m DOUBLE, carry_monitor_m DOUBLE, carry_measured_m DOUBLE, carry_measured_error_m DOUBLE, flight_source VARCHAR DEFAULT '' NOT NULL, set_aside BOOLEAN DEFAULT 0 NOT NULL, 
	PRIMARY KEY (campaign, shot), 
	FOREIGN KEY(campaign) REFERENCES campaigns (id)
);
INSERT INTO "shots" VALUES('two-20261121T120000',1,1,1,'driver','tour','valid','',42.1,NULL,NULL,NULL,NULL,NULL,NULL,NULL,NULL,NULL,NULL,NULL,181.25,NULL,NULL,NULL,'simulated','','','2026-11-21 12:00:00.000000',NULL,'default','test',1,1,3,298.15,NULL,NULL,'swings/1',10,NULL,NULL,NULL,NULL,'',0);
INSERT INTO "shots" VALUES('two-20261121T120000',2,1,1,'driver','tour','valid','',42.1,NULL,NULL,NULL,NULL,NULL,NULL,NULL,NULL,NULL,NULL,NULL,181.25,NULL,NULL,NULL,'simulated','','','2026-11-21 12:00:00.000000',NULL,'default','test',1,1,3,298.15,NULL,NULL,'swings/2',20,NULL,NULL,NULL,NULL,'',0);
CREATE TRIGGER calibrations_no_update BEFORE UPDATE ON calibrations BEGIN SELECT RAISE(ABORT, 'calibrations are only added'); END;
CREATE TRIGGER calibrations_no_delete BEFORE DELETE ON calibrations BEGIN SELECT RAISE(ABORT, 'calibrations are only added'); END;
CREATE TRIGGER learned_swings_no_update BEFORE UPDATE ON learned_swings BEGIN SELECT RAISE(ABORT, 'learned swings are only added'); END;
CREATE TRIGGER learned_swings_no_delete BEFORE DELETE ON learned_swings BEGIN SELECT RAISE(ABORT, 'learned swings are only added'); END;
CREATE INDEX ix_campaign_events_campaign ON campaign_events (campaign);
CREATE INDEX ix_air_readings_bench ON air_readings (bench);
CREATE TRIGGER air_readings_no_update BEFORE UPDATE ON air_readings BEGIN SELECT RAISE(ABORT, 'readings of the air are only added'); END;
CREATE TRIGGER air_readings_no_delete BEFORE DELETE ON air_readings BEGIN SELECT RAISE(ABORT, 'readings of the air are only added'); END;
CREATE TRIGGER ball_aerodynamics_no_update BEFORE UPDATE ON ball_aerodynamics BEGIN SELECT RAISE(ABORT, 'aerodynamics of balls are only added'); END;
CREATE TRIGGER ball_aerodynamics_no_delete BEFORE DELETE ON ball_aerodynamics BEGIN SELECT RAISE(ABORT, 'aerodynamics of balls are only added'); END;
CREATE INDEX ix_shot_notes_campaign ON shot_notes (campaign);
CREATE INDEX ix_shot_exclusions_campaign ON shot_exclusions (campaign);
COMMIT;
