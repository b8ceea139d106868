//! Every limit and constant, in one place, with its unit and why. L = link clock, S = site clock in the type.

use crate::time::{LinkDuration, SiteDuration};

/// Period of the heartbeat, which is the status: one message a second is what a person watching needs.
pub const HEARTBEAT: LinkDuration = LinkDuration::from_secs(1);
/// No heartbeat for this long: SUSPECT, no new work.
pub const SUSPECT_AFTER: LinkDuration = LinkDuration::from_secs(3);
/// No heartbeat for this long: OFFLINE. One second past the robot's own authority, so the robot always ends first.
pub const OFFLINE_AFTER: LinkDuration = LinkDuration::from_secs(31);
/// Heartbeats with a list that is too long are told of again after this, if there was none that could be read: a person may have closed
/// what was told of them.
pub const REPORT_TOO_LONG_TOLD_EVERY: LinkDuration = LinkDuration::from_secs(600);
/// A robot that is refused so often because what it says cannot be read ...
pub const MISREADS_TOLD: u32 = 5;
/// ... within this is a person's matter.
pub const MISREADS_WITHIN: LinkDuration = LinkDuration::from_secs(60);
/// Heartbeats of one session after which such a robot is served again: about a minute.
pub const UNDERSTOOD_AFTER: u64 = 60;
/// Robot side: authority to go on with an attempt after sending the newest heartbeat that was echoed.
pub const AUTHORITY: LinkDuration = LinkDuration::from_secs(30);
/// Server side: the lease over the same authority; 2 % and more above [`AUTHORITY`] for clock drift.
pub const LEASE: LinkDuration = LinkDuration::from_secs(31);
/// Validity of an offer from the heartbeat that anchors it.
pub const OFFER_VALID: LinkDuration = LinkDuration::from_secs(5);
/// Validity of a permission to enter a place.
pub const PLACE_ENTRY_VALID: LinkDuration = LinkDuration::from_secs(10);
/// Validity of a resume order.
pub const RESUME_VALID: LinkDuration = LinkDuration::from_secs(10);
/// Heartbeats whose send time a robot remembers. 64 s at one a second covers every validity.
pub const HEARTBEATS_REMEMBERED: usize = 64;
/// How long a robot may take to confirm a stop before a person is asked.
pub const STOP_CONFIRM: LinkDuration = LinkDuration::from_secs(15);
/// How long an attempt may stay UNCERTAIN before a person is asked.
pub const UNCERTAIN_LIMIT: LinkDuration = LinkDuration::from_secs(300);
/// After a start of fleet no timer fires for this long: robots say hello first.
pub const TIMER_GRACE: LinkDuration = LinkDuration::from_secs(10);
/// No progress of a running step for this long: stall.
pub const STALL_DEFAULT: SiteDuration = SiteDuration::from_secs(60);
/// Being ready this long promotes a task by one class; a person is asked if no known robot could ever do it.
pub const MAX_WAIT: SiteDuration = SiteDuration::from_secs(15 * 60);
/// A robot that says this long that its own safety system stopped it, that a person drives it or that it has a fault, or whose breaker is open
/// this long, is an incident, unless the rules of its area say another time. Link clock.
pub const LASTS_BEFORE_INCIDENT: LinkDuration = LinkDuration::from_secs(60);
/// What the rules of an area may say instead, milliseconds: a second, up to a day.
pub const INCIDENT_AFTER_MS: std::ops::RangeInclusive<u64> = 1_000..=24 * 3_600_000;
/// What a robot says is kept anew after this long for people who ask before it is heard again. An hour: 10,000 robots then leave some 1.7
/// million entries in the feed in the week that it keeps, far below the twenty at which older ones go.
pub const LAST_HEARD_EVERY: LinkDuration = LinkDuration::from_secs(3_600);
/// What stands this long without a reason that anybody could tell is counted as unexplained. Link clock.
pub const UNEXPLAINED_AFTER: LinkDuration = LinkDuration::from_secs(10);
/// Robots, and as many tasks, that are looked at for that in one sweep: a few filters each, well below a millisecond.
pub const UNEXPLAINED_LOOKS: usize = 32;
/// A task that waits for a robot this long is a backlog that people should know of, whatever its class.
pub const BACKLOG_AGE: SiteDuration = SiteDuration::from_secs(3_600);
/// The incident of a backlog opens again no sooner after it closed: an age that swings around the bound is one matter.
pub const BACKLOG_PAUSE: SiteDuration = SiteDuration::from_secs(600);
/// The agent's own start_to_close ends this much earlier than the server's, permille.
pub const AGENT_TIMEOUT_EARLIER_PERMILLE: u64 = 50;
/// Robot breaker: this many failed attempts ...
pub const BREAKER_FAILURES: usize = 3;
/// ... within this time take the robot out of dispatch until a person says so.
pub const BREAKER_WINDOW: SiteDuration = SiteDuration::from_secs(600);
/// So long a queued task that a robot failed goes to another that could do it, even if that one has other work now.
pub const OTHERS_FIRST: SiteDuration = SiteDuration::from_secs(60);
/// After an offer that it heard and did not answer a robot gets none for this long; it doubles with each in a row ...
pub const UNANSWERED_PAUSE: LinkDuration = LinkDuration::from_secs(2);
/// ... up to this.
pub const UNANSWERED_PAUSE_MAX: LinkDuration = LinkDuration::from_secs(60);
/// More robots than this that miss an offer ...
pub const UNANSWERED_ROBOTS_MAX: usize = 3;
/// ... or two and more that are a larger part of all robots, permille ...
pub const UNANSWERED_PERMILLE_MAX: usize = 200;
/// ... within this time are not to blame: the server or its network is.
pub const UNANSWERED_AT_ONCE: LinkDuration = LinkDuration::from_secs(10);
/// A robot that was told of no work and still lists an attempt that the server does not know of after this is a person's matter.
pub const ATTEMPT_UNKNOWN_AFTER: LinkDuration = LinkDuration::from_secs(60);
/// After an errand that a robot refused, failed or dropped, or ended sooner than this, it gets no other for this long.
pub const ERRAND_PAUSE: LinkDuration = LinkDuration::from_secs(5);
/// Refusals in a row before a person is asked: NO_ROBOT_ACCEPTS.
pub const REFUSALS_IN_ROW: u32 = 5;
/// Attempts of a task that robots may drop before a person is asked, whatever retries it asked for: a restarted agent is not its fault.
pub const DROPS_TOLERATED: u32 = 3;
/// A turn of fleet takes no longer than this, commit included: people and their commands wait for it.
pub const TURN: LinkDuration = LinkDuration(20);
/// Decisions that each stage of a turn makes before the next is due: a turn of all stages commits in some 10 ms. Slower machines make fewer.
pub const DECISIONS_PER_STAGE: usize = 256;
/// Fewer would not make a turn shorter: the disk takes as long for one.
pub const DECISIONS_PER_STAGE_MIN: usize = 32;
/// Looks that take as long as one decision: at a ready task, or at a robot for it.
pub const LOOKS_PER_DECISION: usize = 16;
/// Entries of the feed that one turn takes: some 20 us each.
pub const ENTRIES_PER_TURN: usize = 256;
/// Robots that the questions of one turn are about, together: an explanation looks at each for some microseconds.
pub const ROBOTS_ASKED_PER_TURN: usize = 4_096;
/// Questions and commands that one turn takes.
pub const REQUESTS_PER_TURN: usize = 64;
/// Steps of one task.
pub const STEPS_MAX: usize = 64;
/// Task types that a site has registered at once: more than anybody tells apart, and a list that is one message.
pub const TASK_TYPES_MAX: usize = 64;
/// Names of task types that a site keeps, also of deleted ones: fits one page of a list. Two processes at once may pass it by one.
pub const TASK_TYPE_NAMES_MAX: usize = 256;
/// One task type as JSON, bytes: all of them are 1 MiB.
pub const TASK_TYPE_BYTES_MAX: usize = 16 * 1024;
/// Fields of one task type.
pub const TYPE_FIELDS_MAX: usize = 32;
/// Choices of one field of a task type.
pub const TYPE_CHOICES_MAX: usize = 32;
/// Text that one field of a task type takes, bytes: 8 of the longest fit the parameters of one action.
pub const TYPE_TEXT_BYTES_MAX: u32 = 1_024;
/// A unit of a field of a task type, bytes.
pub const TYPE_UNIT_BYTES_MAX: usize = 16;
/// Whole numbers of a field of a task type, either side of zero: beyond, a number on the wire is not exact.
pub const TYPE_INTEGER_MAX: i64 = 1 << 53;
/// Labels of one task or robot.
pub const LABELS_MAX: usize = 32;
/// Dependencies of one task.
pub const DEPENDS_ON_MAX: usize = 32;
/// Attempts of one task after the first.
pub const RETRY_TIMES_MAX: u32 = 100;
/// Shortest and longest timeout of a task, milliseconds of site time.
pub const TASK_TIMEOUT_MS: std::ops::RangeInclusive<u64> = 1_000..=86_400_000;
/// Items in one SubmitTasks call.
pub const SUBMIT_ITEMS_MAX: usize = 10_000;
/// Items committed together from one SubmitTasks call.
pub const SUBMIT_SLICE: usize = 500;
/// Bytes of one SubmitTasks call that are read ahead of what is committed. HTTP/2 ends a connection with some 2,600 unread frames
/// of less than 256 bytes each; 10,000 such items fit here, larger ones are held back by flow control.
pub const SUBMIT_AHEAD_BYTES: u32 = 4 * 1024 * 1024;
/// Name of a reason code that comes in a message, bytes: twice the longest of ours, since a newer version may have longer ones.
pub const CODE_BYTES_MAX: usize = 64;
/// A reason given by a person, bytes.
pub const REASON_BYTES_MAX: usize = 256;
/// Parameters of one action as JSON, bytes.
pub const PARAMS_BYTES_MAX: usize = 8 * 1024;
/// Lists and objects within each other in the parameters of one action: readers of messages give up at 100 levels, and each of these takes
/// two of them.
pub const PARAMS_DEPTH_MAX: usize = 16;
/// Page size if none is asked, and at most.
pub const PAGE_DEFAULT: usize = 100;
/// Largest page.
pub const PAGE_MAX: usize = 1_000;
/// Tasks that one call of a list looks at, about, before it answers with what it found: some 100 ms of reading. No filter that an index serves
/// comes near it.
pub const LIST_ROWS_READ_MAX: usize = 10_000;
/// Parameters of all actions of one task as JSON, bytes: 4 of the largest, or 512 bytes for each of 64 steps.
pub const PARAMS_OF_TASK_BYTES_MAX: usize = 32 * 1024;
/// A message to the task service, bytes: the largest legal task. Lists of numbers are 5.5 times as large on the wire as in JSON.
pub const TASK_MESSAGE_BYTES: usize = 256 * 1024;
/// Calls of SubmitTasks at once over one connection. HTTP/2 ends a connection for unread small frames; so many batches never meet that.
pub const BATCHES_PER_CONNECTION_MAX: usize = 6;
/// A control message, bytes.
pub const CONTROL_MESSAGE_BYTES: usize = 64 * 1024;
/// Sets that a robot lists at Hello: those that its switch record names, what is staged, and room for as many again.
pub const INSTALLED_SETS_MAX: usize = 8;
/// Components that it lists of one set: those of one bundle. It says how many more there are.
pub const INSTALLED_COMPONENTS_MAX: usize = 32;
/// What it says of them, signed, bytes: that many with the longest names, as base64.
pub const INSTALLED_BYTES_MAX: usize = 60 * 1024;
/// A telemetry batch, bytes.
pub const TELEMETRY_BATCH_BYTES: usize = 1024 * 1024;
/// Concurrent streams of one connection.
pub const STREAMS_PER_CONNECTION: u32 = 64;
/// Items one group commit takes at most.
pub const GROUP_COMMIT_ITEMS: usize = 2_000;
/// Bytes of row bodies one group commit takes at most.
pub const GROUP_COMMIT_BYTES: usize = 1024 * 1024;
/// Items of one caller that one group commit takes at most, so that a long plan does not keep others waiting.
pub const COMMIT_SLICE_ITEMS: usize = 256;
/// Bytes of row bodies of one caller that one group commit takes at most, but for a single item.
pub const COMMIT_SLICE_BYTES: usize = GROUP_COMMIT_BYTES / 4;
/// Largest generation, epoch or sequence number that is believed: 2^52 unix milliseconds are 142,000 years, and what is made of it fits 64 bits.
pub const COUNTED_MAX: u64 = 1 << 52;
/// Largest generation of a robot that the server goes on from: half of what is believed, so that what it gives afterwards can be reported too.
pub const GENERATION_FOLLOWED_MAX: u64 = COUNTED_MAX / 2;
/// Milliseconds ahead of the clock up to which numbers of permissions follow what a robot says it has used: a hundred years, further than a clock is
/// set wrong, and far below [`COUNTED_MAX`].
pub const GRANT_AHEAD_MAX_MS: u64 = 100 * 365 * 24 * 3_600_000;
/// Points of one route: with the steps of a task it fits an item and a message. A longer task is split by whoever asks for it.
pub const ROUTE_POINTS_MAX: usize = 2_048;
/// Robots or tasks let go by one item of a resume: each costs up to 8 rows.
pub const RESUMES_PER_ITEM: usize = 16;
/// Hours of a robot that ends no attempt are written this often: a restart forgets less than this.
pub const HOURS_COUNTED_EVERY: SiteDuration = SiteDuration::from_secs(600);
/// A robot with less charge does not change its software, permille: a switch that goes wrong needs time.
pub const ACTIVATE_BATTERY_PERMILLE: u16 = 200;
/// A robot with a hotter joint does not change its software, tenths of a degree Celsius.
pub const ACTIVATE_JOINT_DECIDEGREES: i32 = 700;
/// Tasks on trial and beside it are counted for a gate so often.
pub const TASKS_COUNTED_EVERY: SiteDuration = SiteDuration::from_secs(60);
/// Permission to activate lives so long from the heartbeat it is anchored to.
pub const ACTIVATION_VALID: LinkDuration = LinkDuration::from_secs(5);
/// A robot that was given a bundle and is not heard for so long is lost. Longer than a restart of any machine, also one that boots a new base.
pub const LOST_AFTER: LinkDuration = LinkDuration::from_secs(300);
/// A robot that its drain holds, and that does not ask to activate for so long, works on without the bundle.
pub const READY_WITHIN: SiteDuration = SiteDuration::from_secs(600);
/// A robot whose turn has come and that has not fetched the bundle for so long is passed over.
pub const STAGED_WITHIN: SiteDuration = SiteDuration::from_secs(3_600);
/// A stop by the maker's safety system counts against a bundle for so long after the change to it.
pub const HARDWARE_STOP_COUNTS: SiteDuration = SiteDuration::from_secs(600);
/// A robot that stands for a place is written down after so long, and again each time after it.
pub const PLACE_WAIT_NOTED: SiteDuration = SiteDuration::from_secs(60);
/// A robot on trial that has work and stands for so long is jammed by its bundle, if the others are not.
pub const JAMMED_AFTER: SiteDuration = SiteDuration::from_secs(300);
/// Robots that are compared with those that are not heard: fewer tell nothing.
pub const CONTROLS_MIN: usize = 3;
/// Of these, so many must be heard, permille, for a robot to be lost by its bundle.
pub const CONTROLS_HEARD_PERMILLE: usize = 800;
/// A directive that was not taken is signed anew after so long: half its life.
pub const DIRECTIVE_RENEWED_MS: u64 = 84 * 3_600_000;
/// Roll-outs that have not ended.
pub const ROLLOUTS_OPEN_MAX: usize = 64;
/// Roll-outs kept; the oldest ended ones go first.
pub const ROLLOUTS_MAX: usize = 1_000;
/// Incidents kept; the oldest go first, closed ones before open ones.
pub const INCIDENTS_MAX: usize = 10_000;
/// Open incidents with one code that the words of one robot make.
pub const INCIDENTS_OF_ROBOT_MAX: usize = 8;
/// Robots that the incident of an overfull place names; of the others it says how many they are.
pub const CROWD_NAMED_MAX: usize = 8;
/// Rows one item may touch, and facts it may state.
pub const ITEM_ROWS_MAX: usize = 256;
/// Attempts, places, stops and resumes that a robot lists in one heartbeat, of each: as many as one item may touch rows.
pub const REPORTED_LIST_MAX: usize = 256;
/// Answers to requests about one task that its row keeps: the caller of each may ask again for its own as long as so few others came since.
pub const ANSWERS_OF_TASK: usize = 8;
/// Hold tokens that one item changes: each costs up to 2 rows.
pub const HOLDS_PER_ITEM: usize = 64;
/// Hold tokens of one robot: every stop of the site, and as many that only the robot knows. One that is held by so many needs no more.
pub const HOLDS_OF_ROBOT_MAX: usize = 2 * STOPS_MAX + STOPS_FOR_FLEET;
/// Places that one item changes when rows are brought to what a robot reports.
pub const PLACES_PER_ITEM: usize = 64;
/// Places without a grant of ours that a robot is believed to be inside of: more than any body reaches into at once.
pub const CLAIMED_PLACES_MAX: usize = 8;
/// Of these come first whose region, and so many millimetres around it, holds the robot's pose: the longest body and the error of its pose.
pub const CLAIMED_PLACE_MARGIN_MM: i32 = 3_000;
/// After a restore the store does not know what it gave since the backup: for so long nothing unknown is held against a robot that knows more.
pub const RESTORED_LATELY: SiteDuration = SiteDuration::from_secs(600);
/// Charge that must be left at the charger, permille: an hour and a half of waiting on the way.
pub const CHARGE_RESERVE_PERMILLE: u64 = 100;
/// Robots that a search for a safe order of grants walks over: the first of the connected part in queue order; the others count as standing.
pub const SAFE_ORDER_ROBOTS_MAX: usize = 256;
/// Orders that such a search tries: the first is that of the queue.
pub const SAFE_ORDER_TRIES_MAX: u64 = 64;
/// Robots that such a search looks at in all its tries together, each as often as it does: some milliseconds.
pub const SAFE_ORDER_LOOKS_MAX: usize = 16_384;
/// The same of all searches of one round of grants: a turn of the planner must not take longer than some 20 ms where many wait for each other.
pub const SAFE_ORDER_ROUND_LOOKS_MAX: usize = 65_536;
/// Bays whose ways are measured from a waypoint, the nearest by the beeline: each costs a distance field, which is remembered.
pub const BAYS_LOOKED_AT_MAX: usize = 64;
/// Bays that are tried for one robot, the nearest by their ways: where eight are taken, the next is seldom free or near.
pub const BAYS_TRIED_MAX: usize = 8;
/// Places that one robot holds: its end takes them all back in one item, beside its timers and counters.
pub const PLACES_OF_ROBOT_MAX: usize = 128;
/// A decision that the store refused for good so often is put aside: the second refusal shows that trying again does not help.
pub const REFUSALS_UNTIL_ASIDE: u32 = 2;
/// Refused decisions that are remembered; of more the one that sorts first is forgotten.
pub const REFUSED_REMEMBERED: usize = 1_024;
/// Samples in one uplink message.
pub const SAMPLES_PER_MESSAGE: usize = 256;
/// CRITICAL and EVENT samples a robot may send a second before it summarises, and that a server keeps a second of one that sends more.
pub const EVENTS_PER_SECOND: u32 = 50;
/// Of a robot that sent few, so many are kept at once: an outage of five minutes at the full rate, of hours at that of usual work.
pub const EVENTS_BURST: u32 = 300 * EVENTS_PER_SECOND;
/// Unacknowledged STATUS a robot may have under way, bytes.
pub const STATUS_IN_FLIGHT_BYTES: usize = 64 * 1024;
/// Old STATUS samples that a robot sends on its session; more go over its bulk connection: a server that was away for a moment is not
/// dialed twice by everybody.
pub const REPLAY_ON_LINK_MAX: usize = 16;
/// Old STATUS that a robot sends over bulk, bytes a second: a twentieth of a link of 10 Mbit/s.
pub const REPLAY_BYTES_S: u64 = 64 * 1024;
/// Calls of a session to replay over bulk that may come to nothing in a row; then the session itself takes what is left.
pub const REPLAY_TRIES: u32 = 3;
/// STATUS samples a ring keeps per robot before it thins.
pub const RING_STATUS_MAX: usize = 4_096;
/// Days a request_id, an event and a finished id on the robot's ledger are kept.
pub const REMEMBER_DAYS: u64 = 7;
/// Days that what people asked of tasks and robots is kept, to be looked up.
pub const ASKED_DAYS: u64 = 30;
/// Rows about what is not there any more (retired robots, replaced rings, software that a robot ran once) are kept this long, to be looked up.
pub const GONE_KEPT: SiteDuration = SiteDuration::from_secs(30 * 86_400);
/// Ended tasks that one pass takes away: a pass a minute keeps up with 300 ends a second, and lasts seconds.
pub const FORGOTTEN_PER_PASS: usize = 20_000;
/// Days that STATUS samples are kept, if there is room for them so long.
pub const STATUS_DAYS: u64 = 30;
/// Hours that a position is kept as it came: a day, to find out what went wrong in the last shift. Then it is made coarser.
pub const POSITION_PRECISE_HOURS: u64 = 24;
/// What is left of a position then, millimetres: in which square of this side a robot was. An aisle, and not a shelf.
pub const POSITION_COARSE_MM: i32 = 5_000;
/// Days that the audit keeps who decided what: a year, and five weeks to ask about its end.
pub const AUDIT_DAYS: u64 = 400;
/// Milliseconds of the wall between two rows of a chain that quote the heads of the others: what an end that was taken away can hide in.
pub const AUDIT_ANCHOR_EVERY_MS: u64 = 3_600_000;
/// Rows of the audit that one look for what is wanted reads; a page that has found less goes on with the next call.
pub const AUDIT_LOOK_ROWS: usize = 20_000;
/// Finished ids a ledger keeps whatever their age.
pub const LEDGER_IDS_MIN: usize = 100_000;
/// Longest unary call. L
pub const UNARY_DEADLINE: LinkDuration = LinkDuration::from_secs(30);
/// How long CancelTask waits for fleet before it answers with the task as it is.
pub const CANCEL_WAIT: LinkDuration = LinkDuration::from_secs(1);
/// How long a resume of a stop waits until fleet has seen its reset: longer than the copy of a reset and a heartbeat take.
pub const RESUME_WAIT: LinkDuration = LinkDuration::from_secs(3);
/// A person's or another process' late wake costs at most this.
pub const SWEEP: LinkDuration = LinkDuration(250);
/// The process that plans for a service writes so every so often: others see that it is there. L
pub const LEAD_RENEWED_EVERY: LinkDuration = LinkDuration::from_secs(1);
/// A process that could not write so for this long plans no more until it has read the row again: two renewals may be lost. L
pub const LEAD_ENDS_AFTER: LinkDuration = LinkDuration::from_secs(3);
/// Another process takes over when it has seen nothing written for this long: a second past [`LEAD_ENDS_AFTER`], for clocks that run at
/// different rates. L
pub const LEAD_FREE_AFTER: LinkDuration = LinkDuration::from_secs(4);
/// Times that a command of a person is decided anew by a process that does not plan, because what it is about was changed meanwhile.
pub const COMMAND_TRIES: u32 = 8;
/// A process that ends lets another one plan within this, or the other one waits as if it had died. L
pub const LEAD_LEFT_WITHIN: LinkDuration = LinkDuration::from_secs(1);
/// A leader that reads its rows says so long that it leads. What is alive is read in far less; whoever needs longer lets another one try.
pub const LEAD_READS_FOR: LinkDuration = LinkDuration::from_secs(30);
/// Rows of what is over that a projection asks for by id at once.
pub const ASKED_AT_ONCE: usize = 1_000;
/// Open streams are cut this long after Ctrl-C.
pub const HARD_DRAIN: LinkDuration = LinkDuration::from_secs(2);
/// A heartbeat of the older session that arrives so long after the Hello of another machine was not on its way when that came: both are alive.
pub const CLONE_SURE_AFTER: LinkDuration = LinkDuration::from_secs(2);
/// A clone or fenced robot may come back after this.
pub const FENCED_RETRY: LinkDuration = LinkDuration::from_secs(60);
/// Bytes of one site, map or layout file.
pub const SITE_FILE_BYTES: usize = 64 * 1024 * 1024;
/// Bytes of the version of a map.
pub const MAP_VERSION_BYTES: usize = 64;
/// Bytes of one message that brings software to the server.
pub const UPLOAD_PIECE_BYTES: usize = 1024 * 1024;
/// Bytes of one signed document that says which software there is.
pub const SIGNED_DOCUMENT_BYTES: usize = 4 * 1024 * 1024;
/// Files that are being brought at a time; when there is one more, the one left alone longest is thrown away.
pub const UPLOADS_MAX: usize = 64;
/// Software that is brought is made durable this often, bytes: a cut costs less than this.
pub const UPLOAD_SYNC_BYTES: u64 = 16 * 1024 * 1024;
/// A process waits so long for another one that changes the same folder of releases: the longest turn makes a few MiB durable or takes files
/// away. Shorter than [`UNARY_DEADLINE`], so that the caller hears why.
pub const SOFTWARE_TURN_WAIT: LinkDuration = LinkDuration::from_secs(20);
/// Processes that share a folder of releases look this often whether another one published, ms.
pub const SOFTWARE_FOLLOW_EVERY_MS: u64 = 1_000;
/// Bytes of all software that a server keeps, unless it was told otherwise.
pub const SOFTWARE_BYTES_DEFAULT: u64 = 64 * 1024 * 1024 * 1024;
/// Bytes that a server leaves free on the disk when it takes software, unless it was told otherwise: the databases lie there too.
pub const SOFTWARE_SPARE_BYTES_DEFAULT: u64 = 1024 * 1024 * 1024;
/// Days of serving that software is kept which nothing names, unless the server was told otherwise: a release may be brought over a
/// week, and one that was withdrawn by mistake is published again without being brought again.
pub const SOFTWARE_UNNAMED_DAYS_DEFAULT: u64 = 7;
/// Days after its end that a roll-out still names its bundle, site clock: so long it may be tried again or gone back from.
pub const ROLLOUT_NAMES_DAYS: u64 = 30;
/// Serving time between two looks at which software is still named, ms. The first is so long after a start.
pub const COLLECT_EVERY_MS: u64 = 600_000;
/// Files that a robot names as there when it asks for an encoded target of another.
pub const ENCODING_BASES_MAX: usize = 8;
/// A set has been committed for so long before a new base takes the slot of the one before it, ms of UTC on the robot's site clock.
pub const BASE_SETTLED_MS: u64 = 24 * 3_600_000;
/// One call of a program that migrates data may take so long, ms; after that it is called again.
pub const MIGRATION_MS: u64 = 600_000;
/// Bytes of one range of software that a robot asks for.
pub const CHUNK_RANGE_BYTES: u64 = 4 * 1024 * 1024;
/// Bytes of one message of such a range.
pub const CHUNK_BYTES: usize = 256 * 1024;
/// Waypoints of one site; the largest public grid benchmark has about 55,000.
pub const SITE_WAYPOINTS_MAX: usize = 250_000;
/// Lanes of one site: four a waypoint.
pub const SITE_LANES_MAX: usize = 1_000_000;
/// Places of one site.
pub const SITE_PLACES_MAX: usize = 50_000;
/// Speed where people walk and nobody set another one, millimetres per second: a slow walk.
pub const PEOPLE_SPEED_MM_S: u32 = 600;
/// Distance kept to people and things there if nobody set another one, millimetres: an arm's length.
pub const PEOPLE_AVOIDANCE_MM: u32 = 500;
/// Robots whose starting places one site names: twice what one server is built for.
pub const SITE_ROBOTS_MAX: usize = 20_000;
/// Areas of one site.
pub const SITE_AREAS_MAX: usize = 1_000;
/// Memory that a router keeps for distance fields, bytes; the least recently used go first.
pub const ROUTE_FIELDS_BYTES: usize = 64 * 1024 * 1024;
/// Tasks of one list file.
pub const TASK_LIST_MAX: usize = 1_000_000;
/// A robot's clock further off than this is shown as skewed; before an offset is known, a stamp further ahead is flagged. Milliseconds.
pub const SKEW_ALERT_MS: i64 = 2_000;
/// Bytes of a launcher's beacon.
pub const BEACON_BYTES: usize = 256;
/// Robots whose beacons are kept: more than a site has.
pub const BEACONS_MAX: usize = 10_000;
/// Beacons of one address that are looked at in a second: robots behind one router share it, and each sends one.
pub const BEACONS_PER_SOURCE: u32 = 64;
/// Addresses that are heard in a second.
pub const BEACON_SOURCES_MAX: usize = 4_096;
/// A beacon is shown so long; the next one comes after a second.
pub const BEACON_SHOWN: LinkDuration = LinkDuration(5_000);
/// A program that gives no sign within this is started again by its launcher: what is shown as the time by which a robot is back.
pub const BEACON_BACK_WITHIN: LinkDuration = LinkDuration(15_000);
/// A robot checks in with the stop service so often.
pub const CHECK_IN: LinkDuration = LinkDuration::from_secs(1);
/// Without a check-in for so long a robot is shown as unreachable.
pub const CHECK_IN_MISSED: LinkDuration = LinkDuration::from_secs(3);
/// Answered check-ins in a row that end a silence.
pub const CHECK_INS_GOOD: u32 = 3;
/// Silence of the stop service after which a robot drives slowly. Longer than a planned restart of it, twice over.
pub const SILENCE_SLOW: LinkDuration = LinkDuration::from_secs(10);
/// Silence after which it stands. A network that is away for 20 s must not stop work where nobody walks.
pub const SILENCE_STAND: LinkDuration = LinkDuration::from_secs(30);
/// The same among people, or where nobody knows: slower ...
pub const SILENCE_SLOW_PEOPLE: LinkDuration = LinkDuration::from_secs(3);
/// ... and standing.
pub const SILENCE_STAND_PEOPLE: LinkDuration = LinkDuration::from_secs(6);
/// Stops that are engaged and not reset, of one site. The last ones are kept for stops of the whole fleet. One of the whole fleet that is more restrictive than every
/// other of it is engaged beyond that: at most two more, for there are three levels.
pub const STOPS_MAX: usize = 256;
/// Of these, so many are for stops of the whole fleet only.
pub const STOPS_FOR_FLEET: usize = 16;
/// Resets remembered; the oldest are forgotten first, and a robot that was away since then stays stopped until its stop is reset by name.
pub const RESETS_MAX: usize = 2_048;
/// A reset is remembered so long, for robots that were away.
pub const RESETS_KEPT: LinkDuration = LinkDuration::from_secs(90 * 24 * 3_600);
/// How often the stop service looks for resets that are older than that.
pub const RESETS_FORGOTTEN_EVERY: LinkDuration = LinkDuration::from_secs(3_600);
/// Bytes of the mark by which a stop service knows a stop of its own again.
pub const STOP_PROOF_BYTES: usize = 64;
/// Bytes of the public key of these marks.
pub const STOP_KEY_BYTES: usize = 32;
/// Resets that a session of a robot begins with: the newest. One that was away for more of them hears the rest on its stop line.
pub const LINK_RESETS_MAX: usize = 256;
/// Boxes that tell where a stop is: some 2 KiB of a message; larger ones take the place of more.
pub const REGION_BOXES_MAX: usize = 128;
/// A robot this near to a stopped part lies inside, millimetres: how wrong its pose may be, how large it is, and how far it rolls on from 1.5 m/s.
pub const STOP_MARGIN_MM: i32 = 2_000;
/// What a robot drives at most while a stop or a silence slows it, millimetres per second.
pub const STOP_SLOW_MM_S: u32 = 300;
/// Robots that the stop service knows at a time, and lines it holds: two sites of the largest size that is measured.
pub const STOP_ROBOTS_MAX: usize = 20_000;
/// A robot's line to the stop service on which nothing comes up, or nothing is read, for so long is closed.
pub const STOP_LINE_SILENT: LinkDuration = LinkDuration::from_secs(10);
/// A line says who comes within this, or is closed.
pub const STOP_ATTEND_WITHIN: LinkDuration = LinkDuration::from_secs(5);
/// Bytes of the stops that a robot brings whole when it attends; of the rest it brings the names. Little enough for a poor radio within [`CHECK_IN_MISSED`].
pub const STOP_ATTEND_BYTES: usize = 256 * 1024;
/// A machine that is not let in to a robot's line stands in the audit of stops so often.
pub const LINE_HELD_NOTED_EVERY: LinkDuration = LinkDuration::from_secs(600);
/// Bytes of one message of stops and resets to a robot: what every client takes.
pub const STOP_TOLD_BYTES: usize = 60 * 1024;
/// Messages that wait for a robot to read them; with one more it is told everything anew when it reads again.
pub const STOP_OUTBOX_MAX: usize = 16;
/// Answers to check-ins that wait for a robot to read them; the oldest feed its ladder the least and go first.
pub const STOP_ANSWERS_MAX: usize = 4;
/// Someone who engages or resets waits at most this long for the disk before hearing that it is not durable yet.
pub const STOP_DURABLE_WITHIN: LinkDuration = LinkDuration::from_secs(1);
/// What the disk refused is tried again so often.
pub const STOP_DISK_AGAIN: LinkDuration = LinkDuration::from_secs(1);
/// Changes of robots are told to who engaged a stop at most so often.
pub const STOP_CONFIRM_EVERY: LinkDuration = LinkDuration(50);
/// And to who watches the whole.
pub const STOP_STATUS_EVERY: LinkDuration = LinkDuration(100);
/// Who engaged a stop is told of robots for so long at most.
pub const STOP_CONFIRM_FOR: LinkDuration = LinkDuration::from_secs(120);
/// Watches of one process.
pub const WATCHES_MAX: usize = 4_096;
/// Of these, of one robot or token. Where nobody needs to say who it is, there is no such limit.
pub const WATCHES_PER_PRINCIPAL_MAX: usize = 256;
/// A watch that has news and is not read ends after this. Link clock.
pub const WATCH_UNREAD: LinkDuration = LinkDuration::from_secs(30);
/// Rows or entries that a watch of tasks reads at a time: it holds them while its reader asks for nothing.
pub const WATCH_PAGE: usize = 64;
/// Streams that tell of robots at a time. A stop is engaged also when there is no room for one more; its stream then says how it is, and ends.
pub const STOP_WATCHERS_MAX: usize = 256;
/// Request ids of stops that are remembered, the newest.
pub const STOP_REQUESTS_MAX: usize = 1_024;
/// Denials that the audit of stops takes a minute: they share its file and its queue with the stops themselves. Of more the count is kept.
pub const STOP_DENIALS_PER_MINUTE: u32 = 60;
/// Records of the audit of stops that wait for the disk; of more the count is kept.
pub const STOP_AUDIT_QUEUE: usize = 1_024;
/// Whoever looks after a stop service on one box looks again after this, and waits no longer for an answer.
pub const STOP_LOOK_WITHIN: LinkDuration = LinkDuration::from_secs(1);
/// A look that began or ended later than this after its time counts for nothing: the checker itself was held up.
pub const STOP_LOOK_LATE: LinkDuration = LinkDuration(250);
/// So many looks in a row in vain, and the process is ended: with its start anew this is less than what stands a robot among people.
pub const STOP_LOOKS_MISSED: u32 = 3;
/// A process of a stop service is ended at most so often: one that hangs again at once needs a person.
pub const STOP_KILL_EVERY: LinkDuration = LinkDuration::from_secs(30);
/// Whoever writes down for the stop service who is known says so often that it still does, also if nothing changes.
pub const PRINCIPALS_TOLD_EVERY: LinkDuration = LinkDuration::from_secs(10);
/// Bytes of a slot of the latch file: 2,048 resets with their stops and 256 stops with 128 boxes each, as JSON.
pub const STOP_LATCH_BYTES: usize = 8 * 1024 * 1024;

// --- the edge: what a connection may take before, and beside, what its requests may. All L.

/// Connections of one port, if the process may have as many descriptors. Below the 20,000 that some systems give at most, with room for files.
pub const CONNECTIONS_MAX: usize = 16_384;
/// Descriptors of a process that no connection takes: databases, files of stops and software, and who is known.
pub const DESCRIPTORS_KEPT: usize = 512;
/// A port that could take fewer connections than this does not open: a handful of robots with the people beside them need as many.
pub const CONNECTIONS_LEAST: usize = 64;
/// Of what a port with login takes, one in so many is for whoever has not shown yet who it is: connections, and requests without a certificate or a
/// good token.
pub const STRANGERS_PART: usize = 4;
/// Requests of all these under way at a time; the largest message they may send is 64 KiB, so that all of them hold 128 MiB at most.
pub const STRANGER_REQUESTS_MAX: usize = 2_048;
/// Bytes of a question about health: the name of a service.
pub const HEALTH_MESSAGE_BYTES: usize = 1_024;
/// A peer that neither takes what is sent to it nor answers the system's own probes for so long is gone: what of HTTP/1.1 has no pings.
pub const PEER_GONE: LinkDuration = LinkDuration::from_secs(60);
/// Of these, so many from one address (one /64 of IPv6): a quarter, for a site's robots may stand behind one router.
pub const CONNECTIONS_PER_NETWORK_MAX: usize = 4_096;
/// A TLS handshake is done within this: three round trips on the worst radio link, ten times over.
pub const TLS_HANDSHAKE_WITHIN: LinkDuration = LinkDuration::from_secs(5);
/// The head of a connection's first request is there within this; who connects has something to ask.
pub const FIRST_REQUEST_WITHIN: LinkDuration = LinkDuration::from_secs(5);
/// A later head of an HTTP/1.1 connection is there within this, counted from the answer before it: twice a usual scrape interval.
pub const HTTP1_HEAD_WITHIN: LinkDuration = LinkDuration::from_secs(30);
/// Bytes of the head of an HTTP/1.1 request, and of what is read ahead.
pub const HTTP1_HEAD_BYTES: usize = 64 * 1024;
/// Bytes of the header list of an HTTP/2 request, as HTTP/2 counts them: what peers take by default.
pub const HEADER_LIST_BYTES: u32 = 16 * 1024;
/// Bytes of one HTTP/2 stream that are composed ahead of a peer that does not read them, however large its window: one frame of the
/// size that every peer takes.
pub const STREAM_SEND_BYTES: usize = 16 * 1024;
/// A connection without a stream for so long is closed. Longer than what people and programs pause between two calls, and no
/// pause that programs keep (5, 10, 15 minutes) is over at the same moment: a call that meets the end of its connection on
/// the way fails in clients that do not send it again.
pub const CONNECTION_IDLE: LinkDuration = LinkDuration::from_secs(420);
/// A quiet HTTP/2 connection is pinged so often: shorter than what routers forget a connection after.
pub const KEEPALIVE_EVERY: LinkDuration = LinkDuration::from_secs(20);
/// A ping that is not answered within this ends the connection: with the pause before it as long as [`AUTHORITY`].
pub const KEEPALIVE_WITHIN: LinkDuration = LinkDuration::from_secs(10);
/// The first pause when the process has no descriptor or memory for another connection; it doubles with each failure.
pub const ACCEPT_PAUSE: LinkDuration = LinkDuration(100);
/// The longest such pause: a connection waits no longer than this once there is room.
pub const ACCEPT_PAUSE_MAX: LinkDuration = LinkDuration::from_secs(1);
/// An old connection's streams are told so long before HTTP/2 tells the peer: a robot moves over in a second or two.
pub const CONNECTION_NOTICE: LinkDuration = LinkDuration::from_secs(5);
/// A connection that was told to go is closed after this.
pub const CONNECTION_GRACE: LinkDuration = LinkDuration::from_secs(30);
/// Requests under way on one port, open streams included: four a connection.
pub const REQUESTS_MAX: usize = 65_536;
/// Of these, so many of one principal: a quarter.
pub const REQUESTS_PER_PRINCIPAL_MAX: usize = 16_384;
/// Requests a second that one principal may begin for long; who has more to say has a batch or a stream for it.
pub const REQUESTS_PER_SECOND: u32 = 1_000;
/// Requests that it may begin at once.
pub const REQUESTS_BURST: u32 = 2_000;
/// Of what a port or a caller has, so much is kept for each class of calls above the one that asks ([`crate::overload::Class`]), permille: a
/// tenth is enough to decide something and to stop while everything below it is flooded.
pub const CLASS_KEPT_PERMILLE: usize = 100;
/// How often a connection without a certificate is looked at for tokens that have ended: a stream goes on no longer than that behind its token.
pub const CONNECTION_ASKED_AGAIN: LinkDuration = LinkDuration::from_secs(5);
/// Frames of HTTP/2 that ask for nothing (SETTINGS, PRIORITY, PING, WINDOW_UPDATE and such) that one connection may send at once beyond those that it
/// earned: browsers begin with some dozens.
pub const CONTROL_FRAMES_BURST: u64 = 1_024;
/// The same for long: a peer that pings each second, and a hundred times more.
pub const CONTROL_FRAMES_PER_SECOND: u64 = 128;
/// What one frame of an answer, or one request, lets in more: a WINDOW_UPDATE for the stream, one for the connection, a ping that measures the line, and
/// a reset.
pub const CONTROL_FRAMES_PER_ANSWER: u64 = 4;
/// So many that were earned are remembered: a client that was held up reads a full window of small messages at once.
pub const CONTROL_FRAMES_EARNED_MAX: u64 = 1 << 18;
/// Usual age at which a connection is asked to go, a tenth more or less. With notice and grace it ends within an hour: a certificate that was renewed is
/// soon the one in use, and connections spread anew over the processes behind a proxy.
pub const CONNECTION_AGE: LinkDuration = LinkDuration::from_secs(54 * 60);
/// What streams of an old connection are ended with is on its way for so long before the connection is cut.
pub const CONNECTION_LAST: LinkDuration = LinkDuration::from_secs(1);
/// A connection whose certificate is denied is told why for so long, then cut.
pub const DENIED_LAST: LinkDuration = LinkDuration::from_secs(3);
/// A robot that hears that its key was taken out dials again after so long: nothing but a person changes that.
pub const REVOKED_RETRY: LinkDuration = LinkDuration::from_secs(60);
/// Hellos of robots that one process carries out at a time; each is a write, and writes of so many are one or two groups.
pub const HELLOS_MAX: usize = 512;
/// Further Hellos that wait on their streams: what a core carries out in half of [`HELLO_WAITS`], if no robot connects meanwhile. The rest are told when to come again, so that a storm of ten
/// thousand is over in seconds.
pub const HELLOS_WAITING_MAX: usize = 2_048;
/// A Hello waits for room no longer than that, half of what a robot waits for its welcome.
pub const HELLO_WAITS: LinkDuration = LinkDuration::from_secs(5);
/// A robot whose Hello found no room comes again after this at the earliest ..
pub const HELLO_AGAIN: LinkDuration = LinkDuration::from_secs(1);
/// .. and after this at the latest; the protocol promises robots that nobody is sent away for longer.
pub const HELLO_AGAIN_MAX: LinkDuration = LinkDuration::from_secs(10);
/// The next one so much after the one before: what a robot costs a core that connects with a handshake and says hello.
pub const HELLO_STEP: LinkDuration = LinkDuration(2);
/// One caller that is denied again and again leaves a row in the audit so often; what lies between is counted in the next row.
pub const DENIALS_EVERY: LinkDuration = LinkDuration::from_secs(60);
/// Rows of one caller at once.
pub const DENIALS_BURST: u32 = 16;
/// All denied callers of one port together leave a row so often: a flood for a year fills 15 GB.
pub const DENIALS_ALL_EVERY: LinkDuration = LinkDuration::from_secs(1);
/// Rows of all at once.
pub const DENIALS_ALL_BURST: u32 = 128;
/// Denials that wait to be written; of more the count is kept.
pub const DENIALS_QUEUED_MAX: usize = 256;
/// Bytes of the path of a denied request that are kept: longer than any of ours.
pub const DENIED_PATH_BYTES: usize = 128;
/// Principals whose rate is remembered; the one heard longest ago is forgotten first, and begins anew.
pub const RATES_REMEMBERED: usize = 16_384;

// --- logs

/// So many lines of one kind about one peer are written before they are only counted: a robot that comes and goes a few times is seen each time.
pub const FLOOD_LINES: u32 = 4;
/// How often what was only counted is said.
pub const FLOOD_COUNTED_EVERY: LinkDuration = LinkDuration::from_secs(60);
/// Peers that are counted each for itself; more than robots of a site that come at once, twice over.
pub const FLOOD_PEERS_MAX: usize = 1_024;

// --- clocks

/// The wall clock jumped if it is so far from where the monotonic clock expects it: more than NTP steps a clock that it keeps.
pub const CLOCK_JUMP: LinkDuration = LinkDuration::from_secs(5);
/// A jump of more than this is no correction of a clock that ran: a machine slept, or somebody set it.
pub const CLOCK_JUMP_LARGE: LinkDuration = LinkDuration::from_secs(3_600);
/// Connections that stand at a large jump ahead stay for so long though their tokens are over by it: time to look and to set the clock right.
pub const CLOCK_JUMP_STANDING: LinkDuration = LinkDuration::from_secs(600);
/// The wall may drift by one part of so many without a jump: twice what Linux slews.
pub const CLOCK_SLEW_PART: u64 = 1_000;
/// Nothing is signed by a wall that stepped more than this while it ran. Far below the day that a timestamp lives, and above what NTP steps.
pub const CLOCK_DOUBT: LinkDuration = LinkDuration::from_secs(300);
/// Nor by one that at a start is further than this past the newest time of the store that was in no doubt: longer than a site stands still over holidays of a week.
pub const CLOCK_DOUBT_START: LinkDuration = LinkDuration::from_secs(7 * 24 * 3_600);

// --- identity

/// How long a certificate of a robot is good, link clock. It is renewed at half of it.
pub const ROBOT_CERTIFICATE_VALID: LinkDuration = LinkDuration::from_secs(7 * 24 * 3_600);
/// How long a certificate of a server process is good, link clock. It is renewed at half of it.
pub const SERVER_CERTIFICATE_VALID: LinkDuration = LinkDuration::from_secs(90 * 24 * 3_600);
/// How long the site's own root is good: it outlives the machines.
pub const AUTHORITY_VALID: LinkDuration = LinkDuration::from_secs(20 * 365 * 24 * 3_600);
/// Clocks of robots may be slow by so much when they get their first certificate.
pub const CERTIFICATE_BACKDATED: LinkDuration = LinkDuration::from_secs(24 * 3_600);
/// A key that was taken out is denied for as long as a certificate of it may be genuine, and a day for clocks that differ.
pub const KEY_DENIED_FOR: LinkDuration = LinkDuration::from_secs(8 * 24 * 3_600);
/// A secret that enrols a robot is good for an hour.
pub const ENROLMENT_VALID: LinkDuration = LinkDuration::from_secs(3_600);
/// A token whose time is over may engage stops for so much longer: a forgotten renewal must not take the stop away from a wall panel.
pub const TOKEN_STOPS_AFTER_EXPIRY: LinkDuration = LinkDuration::from_secs(30 * 24 * 3_600);
/// Longest life of a token, link clock.
pub const TOKEN_VALID_MAX: LinkDuration = LinkDuration::from_secs(366 * 24 * 3_600);
/// A token that was rotated is good for so much longer at most: programs on several machines get the new one meanwhile.
pub const TOKEN_OVERLAP_MAX: LinkDuration = LinkDuration::from_secs(7 * 24 * 3_600);
/// Tokens of a site that were not revoked.
pub const TOKENS_MAX: usize = 10_000;
/// Grants of one token.
pub const GRANTS_MAX: usize = 64;
/// Bytes of a signing request, PEM.
pub const SIGNING_REQUEST_BYTES: usize = 8 * 1024;
/// Names and addresses of a server's certificate.
pub const SERVER_NAMES_MAX: usize = 32;
