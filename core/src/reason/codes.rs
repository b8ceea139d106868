//! The closed list of reasons.

use std::fmt;

macro_rules! codes {
    ($($variant:ident = $text:literal, $meaning:literal $(=> $next_step:literal)?;)*) => {
        /// One reason, UPPER_SNAKE on the wire.
        #[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
        pub enum Code {
            $(#[doc = $meaning] $variant,)*
        }
        impl Code {
            /// Every code.
            pub const ALL: &'static [Code] = &[$(Self::$variant),*];
            /// The name on the wire.
            pub const fn as_str(self) -> &'static str {
                match self { $(Self::$variant => $text),* }
            }
            /// What it means and what to try, for a person: it ends with [`Self::next_step`].
            pub const fn help(self) -> &'static str {
                match self { $(Self::$variant => concat!($meaning $(, " ", $next_step)?)),* }
            }
            /// What a caller tries next that got this for an answer; empty: it says all that there is to say.
            pub const fn next_step(self) -> &'static str {
                match self { $(Self::$variant => concat!($($next_step)?)),* }
            }
        }
    };
}

codes! {
    // --- of a newer version
    Unknown = "UNKNOWN", "A newer version of midshift gave this reason."
        => "Its name is shown; that version's `midshift explain-error` explains it.";
    // --- answers to a caller
    InvalidRequest = "INVALID_REQUEST", "The request broke one or more rules; each is listed."
        => "Mend them all and send it again.";
    TaskNotFound = "TASK_NOT_FOUND", "No task has this id." => "`midshift task ls` lists those that there are.";
    RobotNotFound = "ROBOT_NOT_FOUND", "No robot has this id."
        => "`midshift robot ls` lists those that have ever connected, `midshift robot identities` those that are enrolled.";
    PlaceNotFound = "PLACE_NOT_FOUND", "The site has no such place." => "`midshift zone ls` lists its places.";
    PinnedRobotUnknown = "PINNED_ROBOT_UNKNOWN", "The task names a robot that is not enrolled and has never connected; it waits until it comes."
        => "`midshift robot ls` lists those that are known.";
    IncidentNotFound = "INCIDENT_NOT_FOUND", "No open incident has this id." => "`midshift incident ls` lists them.";
    AreaNotFound = "AREA_NOT_FOUND", "The site has no such area." => "Its areas are named in the site file.";
    PlanNotFound = "PLAN_NOT_FOUND", "The process that plans remembers no such plan." => "`midshift planner plans` lists those that it remembers.";
    TaskTypeNotFound = "TASK_TYPE_NOT_FOUND", "The site has no such task type registered."
        => "`midshift task type ls` lists those that there are.";
    TaskTypesFull = "TASK_TYPES_FULL", "The site has as many task types as it may, 64, or names of types, 256 with those deleted within a month."
        => "Delete a type, or put one of a name that was there before.";
    RequestIdReused = "REQUEST_ID_REUSED", "This request_id was used with another body."
        => "Use a new one for a new request.";
    TaskIdTaken = "TASK_ID_TAKEN", "A task with this id exists with another body."
        => "Choose another id or leave it empty.";
    EtagMismatch = "ETAG_MISMATCH", "The object changed since you read it." => "Read it again and decide again.";
    NotSupportedYet = "NOT_SUPPORTED_YET", "The server does not have what the request asks for, so it is refused rather than carried out in part."
        => "Update the server, or ask without it.";
    TaskEnded = "TASK_ENDED", "The task is over and cannot be changed." => "Submit another one.";
    NotAllowedNow = "NOT_ALLOWED_NOW", "The state of the object does not allow this now." => "Read it again.";
    TaskNotEditable = "TASK_NOT_EDITABLE", "A task changes only while no robot has it or may have it, and no person must answer it."
        => "Change it once it is QUEUED again, or cancel it and submit another one.";
    AnswerUnknown = "ANSWER_UNKNOWN", "Nobody knows any more what became of the request: fleet passed it over, or answered many others about the task since."
        => "`midshift task get TASK` shows the task as it is. Ask again with another request_id.";
    NotStuck = "NOT_STUCK", "The robot is not stuck on its way back from a bundle." => "`midshift robot explain ROBOT` says what it waits for.";
    ResolutionNotAllowed = "RESOLUTION_NOT_ALLOWED", "This resolution is not among the task's allowed resolutions."
        => "`midshift task get TASK` lists those.";
    PlaceNotBlocked = "PLACE_NOT_BLOCKED", "Nobody blocked this place." => "`midshift zone ls` shows which are blocked.";
    PlaceNotClear = "PLACE_NOT_CLEAR", "A robot reports that it stands in this place." => "Move it out first.";
    CursorExpired = "CURSOR_EXPIRED", "The cursor is older than what is kept." => "Start again without one.";
    CursorOfOtherStore = "CURSOR_OF_OTHER_STORE", "The cursor comes from another store." => "Start again without one.";
    StoreUnavailable = "STORE_UNAVAILABLE", "The store does not answer. Nothing was decided." => "Try again.";
    CommitUnknown = "COMMIT_UNKNOWN", "Nobody knows whether it was committed."
        => "Send it again with the same request_id.";
    MovedMeanwhile = "MOVED_MEANWHILE", "What the request is about was changed each time it was to be written. Nothing was done."
        => "Send it again.";
    Overloaded = "OVERLOADED", "A queue is full." => "Try again later.";
    TooManyRequests = "TOO_MANY_REQUESTS", "One caller has more requests open, or begins more a second, than it may."
        => "Wait as long as the answer says, and send many things in one batch or over one stream.";
    DeadlineExceeded = "DEADLINE_EXCEEDED", "The call took longer than its deadline. The outcome is unknown."
        => "Ask again with the same request_id.";
    Internal = "INTERNAL", "A fault of midshift." => "Look for the request_id in the server's log.";
    // --- who asks, and what it may
    SignInNeeded = "SIGN_IN_NEEDED", "Nobody knows who asks."
        => "Sign in with `midshift login`, or send the header authorization: Bearer TOKEN.";
    TokenUnknown = "TOKEN_UNKNOWN", "The token is none of this site, or it was revoked."
        => "Ask whoever runs the site for another one.";
    TokenExpired = "TOKEN_EXPIRED", "The token's time is over. It may still engage stops for 30 days."
        => "Ask whoever runs the site for another one.";
    NotPermitted = "NOT_PERMITTED", "No role that you were given permits this here."
        => "`midshift context show` says which you have; whoever runs the site can give more.";
    NotThisRobot = "NOT_THIS_ROBOT", "A robot speaks for itself alone, by its own certificate."
        => "Enrol the machine under the name it uses.";
    NotYourOwn = "NOT_YOUR_OWN", "Whoever wrote a roll-out does not approve it."
        => "Ask somebody else with role ota-approver.";
    RobotEnrolled = "ROBOT_ENROLLED", "The robot is enrolled with another machine."
        => "`midshift robot replace ROBOT` lets another take its place; `midshift robot revoke ROBOT` takes its key out.";
    EnrolmentUnknown = "ENROLMENT_UNKNOWN", "The secret is none that was handed out last for this robot."
        => "Enrol it again and use the new line.";
    EnrolmentUsed = "ENROLMENT_USED", "The secret was used by another machine."
        => "If that was not you, revoke the robot; then enrol it again.";
    EnrolmentExpired = "ENROLMENT_EXPIRED", "The secret was good for an hour."
        => "Enrol the robot again and use the new line.";
    KeyDenied = "KEY_DENIED", "The key of this machine was revoked or replaced, or is not the robot's."
        => "Remove its identity folder and enrol it anew.";
    TokenNotFound = "TOKEN_NOT_FOUND", "No token has this id." => "`midshift token ls` lists them.";
    TokenNameTaken = "TOKEN_NAME_TAKEN", "A token of this name stands, and names are unique among those that do."
        => "Choose another name, or replace it with `midshift token rotate NAME`; of several of one name that an older release made, revoke those that nobody uses by their ids.";
    LastAdmin = "LAST_ADMIN", "It is the last token that may administer the site." => "Make another one first.";
    // --- fleet stop
    StopsFull = "STOPS_FULL", "As many stops are engaged as there may be; the last ones are kept for the whole fleet."
        => "Engage the whole fleet, or reset what is over.";
    OtherSite = "OTHER_SITE", "This is the stop service of another site than the one that was meant; nothing was stopped or reset."
        => "Name the right one with --stop-server, or \
        sign in to the site that you mean.";
    StopNotFound = "STOP_NOT_FOUND", "Nothing is known of this stop."
        => "`midshift stop status` says which are engaged; a robot that stands says what it waits for.";
    StopWasReset = "STOP_WAS_RESET", "The stop was reset, so nobody obeys it any more."
        => "Engage another one with a new request_id.";
    StopMemoryLost = "STOP_MEMORY_LOST", "The stop service began without its latch or its key, so it stopped the whole fleet."
        => "Look at the floor and at `midshift stop status`, find out who removed its files, then reset that stop by name.";
    StopServiceHung = "STOP_SERVICE_HUNG", "The stop service answers nothing and was not replaced. Robots stand by its silence."
        => "Look at its log and at its machine; end its process by hand, and it is started again.";
    LineReplaced = "LINE_REPLACED", "A newer line of this robot took the place of this one."
        => "If two machines use one robot id, find the second.";
    LineHeld = "LINE_HELD", "Another start of this robot is heard on its line to the stop service, so this one is not let in. It dials again by itself and is let in when the other has ended."
        => "If two machines use one robot id, find the second and revoke the key.";
    // --- software on the server
    SoftwareNotFound = "SOFTWARE_NOT_FOUND", "No signed release lists this file, or no document has this name."
        => "`midshift bundle ls` lists what is published.";
    NoOnlineKeys = "NO_ONLINE_KEYS", "The server has no keys that may say which release is the newest."
        => "Start it with --ota-keys and the folder that holds them.";
    ClockDoubted = "CLOCK_IN_DOUBT", "The server's clock jumped, or began far past what it wrote before. It signs nothing by it: no order to robots, no timestamp, no certificate."
        => "Set the clock of its machine from the network (NTP); or, if it is right, run there `midshift doctor --accept-clock`. See docs/runbooks/clock.md.";
    ServedElsewhere = "SERVED_ELSEWHERE", "This process is a gateway: releases are brought to, and listed by, processes with role ota."
        => "Ask at the public address.";
    UploadTooLarge = "UPLOAD_TOO_LARGE", "A file of a release has at most 8 GiB."
        => "Split it into several components.";
    UploadMoved = "UPLOAD_MOVED", "The file goes on at another byte than this piece."
        => "Ask GetUpload and go on from there.";
    UploadCorrupt = "UPLOAD_CORRUPT", "What was brought is not what its digest says, and was thrown away."
        => "Bring it again.";
    SoftwareFull = "SOFTWARE_FULL", "The room for software on the server is used up."
        => "Withdraw bundles that nobody needs with bundle withdraw and push that, give it more with --ota-quota-gib, or a larger disk.";
    ReleaseMoved = "RELEASE_MOVED", "Somebody else published."
        => "Take the server's newest documents, sign on top of them and push again.";
    FilesMissing = "FILES_MISSING", "The release lists files that the server does not have."
        => "Bring them, then publish again.";
    BundleNotFound = "BUNDLE_NOT_FOUND", "No published release has this bundle."
        => "`midshift bundle ls` lists what is published.";
    BundleRevoked = "BUNDLE_REVOKED", "The bundle was taken back, or the newest release lists it no more. No robot gets it."
        => "Choose another one: `midshift bundle ls` lists them.";
    RolloutNotFound = "ROLLOUT_NOT_FOUND", "No roll-out has this id." => "`midshift rollout ls` lists them.";
    RolloutIdTaken = "ROLLOUT_ID_TAKEN", "A roll-out with this id exists with another body." => "Choose another id.";
    RolloutOverlap = "ROLLOUT_OVERLAP", "Another roll-out has some of these robots."
        => "Wait until it has ended, abort it, or start this one with supersede.";
    RolloutMatchesNobody = "ROLLOUT_MATCHES_NOBODY", "No robot fits what was selected."
        => "Select others, or mend what keeps these out: the answer counts them by reason, and `midshift explain-error REASON` explains one.";
    RolloutFullPush = "ROLLOUT_FULL_PUSH", "The first wave has more than one robot and more than a tenth of all."
        => "Make it smaller, or say allow_full_push.";
    BudgetImpossible = "BUDGET_IMPOSSIBLE", "The area's rules keep so many robots in work that none can be taken out."
        => "`midshift area put AREA` changes them.";
    NothingToRevert = "NOTHING_TO_REVERT", "No robot keeps what this roll-out brought."
        => "`midshift rollout get ROLLOUT --robots` says how far each of its robots is.";
    QuarantineNotFound = "QUARANTINE_NOT_FOUND", "This robot has no such bundle in quarantine."
        => "`midshift quarantine ls` lists them.";
    RobotNotLost = "ROBOT_NOT_LOST", "The robot is heard, is not out of work for this roll-out, or has not been silent for as long as the roll-out bears."
        => "`midshift rollout explain ROLLOUT ROBOT` says what it waits for; once it is lost, an incident says so.";
    // --- why a robot does not get a task
    RobotPinnedElsewhere = "ROBOT_PINNED_ELSEWHERE", "The task names another robot.";
    MissingCapability = "MISSING_CAPABILITY", "The robot cannot do one of the task's actions or lacks a required capability.";
    LabelMismatch = "LABEL_MISMATCH", "The robot's labels do not match the task's selector.";
    PayloadTooHeavy = "PAYLOAD_TOO_HEAVY", "The task needs more payload than the robot can carry.";
    SoftwareTooOld = "SOFTWARE_TOO_OLD", "The robot's software is older than the task asks for.";
    RobotOffline = "ROBOT_OFFLINE", "No heartbeat for 31 s or never connected. Look at its network and power.";
    RobotSuspect = "ROBOT_SUSPECT", "No heartbeat for 3 s; it gets no new work until it is heard again.";
    RobotManual = "ROBOT_MANUAL", "The robot is in manual or service mode: a person drives it. Bring it back to automatic mode at the robot.";
    RobotCordoned = "ROBOT_CORDONED", "A person took the robot out of dispatch. Uncordon it.";
    RobotBrokenOff = "ROBOT_BROKEN_OFF", "Three failed attempts in ten minutes took the robot out of dispatch. Look at it, then uncordon it.";
    RobotDraining = "ROBOT_DRAINING", "The robot is taken out of work for maintenance."
        => "It gets work again when its drain is released, with `midshift robot undrain ROBOT`.";
    RobotHeld = "ROBOT_HELD", "A hold token stands on the robot. Resume it.";
    StopEngaged = "STOP_ENGAGED", "A fleet stop is engaged over the robot."
        => "`midshift stop status` says which; reset it, then resume.";
    RobotStopped = "ROBOT_STOPPED", "The robot reports a stop: of its own safety system, a fleet stop, or because it does not hear the stop service.";
    RobotBusy = "ROBOT_BUSY", "The robot has other work.";
    RobotReconciling = "ROBOT_RECONCILING", "The robot's report differs from the record; it gets work once they agree.";
    RobotObserved = "ROBOT_OBSERVED", "Two sessions claim this robot id. This one is watched and gets no work.";
    RobotLoaded = "ROBOT_LOADED", "The robot carries something that is not of this task."
        => "Take it off at the robot. If nothing is there and the robot only remembers it, `midshift robot load ROBOT --none` says so.";
    RobotFault = "ROBOT_FAULT", "The robot reports a fault that a person must look at.";
    RobotUnlocated = "ROBOT_UNLOCATED", "The robot has not reported a waypoint of this site.";
    BatteryLow = "BATTERY_LOW", "The charge does not reach pickup, drop and a charger with its reserve.";
    NoRoute = "NO_ROUTE", "No lane leads there.";
    EntryPassedOver = "ENTRY_PASSED_OVER", "An entry of the log could not be obeyed and was passed over; the server's log has the details.";
    MapNotTaken = "MAP_NOT_TAKEN", "The site file has changed, and tasks, robots or held places are in the way of it, so the stored map goes on. Start the server again once they are not, or with --force-map.";
    MapForced = "MAP_FORCED", "A changed map was forced upon work that it does not fit. Look at the task, robot or place, and at what stands there.";
    MapDiffers = "MAP_DIFFERS", "The robot drives by another version of the site's map than the server plans on, so it gets no work. Give it the map of the server, or start the server with the new one.";
    MessageTooLarge = "MESSAGE_TOO_LARGE", "The message has more bytes than the port takes."
        => "The text says how many; split it, or leave out what is not needed.";
    RowUnknown = "ROW_UNKNOWN", "A row holds a value of a newer version of midshift. It is left as it is, and what it is about is not acted on."
        => "Start that version again; what it wrote is whole.";
    DecisionPutAside = "DECISION_PUT_ASIDE", "The store refused the same decision twice, so it is not tried again and the robot or place it is about gets no work and no grant."
        => "The server's log has the details; close the incident to try once more.";
    ReportTooLong = "REPORT_TOO_LONG", "A list of the robot's heartbeat is longer than one may be. It is not processed, so the robot loses its authority; its maker must mend it.";
    RobotNotUnderstood = "ROBOT_NOT_UNDERSTOOD", "The robot dials and is refused each time, since what it says breaks the robot protocol. It closes by itself."
        => "Its maker must mend what the reason names.";
    ReportImplausible = "REPORT_IMPLAUSIBLE", "The robot reported a step or an end that cannot be. It frees nothing and moves nothing forward; the robot gets no work while it says so. Look at the robot's software.";
    GoalNotEntered = "GOAL_NOT_ENTERED", "The robot said that a task, or a part of it, was done and was never seen at a place where it had to be for that. The task waits for a person, and the robot gets no work until the incident is closed."
        => "Look where the item is, then `midshift task resolve TASK --as ANSWER --reason TEXT`; look at the robot, then `midshift incident close INCIDENT --reason TEXT`.";
    RobotDoesNotAnswer = "ROBOT_DOES_NOT_ANSWER", "The robot heard three offers within ten minutes and answered none, or refused five in a row. It gets one offer after ten minutes; if it takes that, this ends. Look at its software.";
    OffersNotAnswered = "OFFERS_NOT_ANSWERED", "Many robots did not answer offers at the same time, so none of them is blamed. Look at the server and its network.";
    AttemptUnknown = "ATTEMPT_UNKNOWN", "The robot has an attempt that this server does not know, and does not let it go. Look at the robot; once it stands still, `midshift robot disown ROBOT ATTEMPT` lets the server ignore it.";
    PlacesImplausible = "PLACES_IMPLAUSIBLE", "The robot says that it is inside of more places without a grant than it can be. It keeps what it held, frees nothing and gets no work and no grant until it says less or the incident, which names the places, is closed. Look where it is.";
    ExclusionBroken = "EXCLUSION_BROKEN", "More robots say that they are inside of one place than it has room for. Nobody else is let in. Look at them, move some away, or clear the place.";
    GrantUnknown = "GRANT_UNKNOWN", "The robot entered a place on a grant that this server did not give. Look at the robot's software, or for a second server.";
    WorkUnreadable = "WORK_UNREADABLE", "The robot cannot read the work that it was sent and acts as if its authority had ended. Its software is too old for this server, or the other way round.";
    AssignmentUnlawful = "ASSIGNMENT_UNLAWFUL", "The record of the task names a step that it does not have, so the robot was not sent it. A person must resolve the task.";
    RouteTooLong = "ROUTE_TOO_LONG", "The way through all goals of the task has more points than a robot takes. Split the task.";
    PlaceOccupied = "PLACE_OCCUPIED", "A place on the way is held by another robot, or closed because nobody knows what a robot does there."
        => "`midshift zone ls --in-use` shows who holds it. If it is closed, look there, then `midshift zone clear PLACE --reason TEXT --if-match ETAG`.";
    UnsafeOrder = "UNSAFE_ORDER", "The places on the way are free, and if the robot went on now, robots could stand in each other's way for ever. It goes on once others have gone first; nobody has to do anything."
        => "If it lasts, one of the robots that it names does not go on: `midshift robot explain ROBOT` says why.";
    ExcludedAfterFailure = "EXCLUDED_AFTER_FAILURE", "The robot failed this task and the task asks for another.";
    BoundElsewhere = "BOUND_ELSEWHERE", "The task is opened: its item is on another robot.";
    // --- why a task waits or ended
    WaitingForRobot = "WAITING_FOR_ROBOT", "No robot passes all filters now.";
    WaitingForDependency = "WAITING_FOR_DEPENDENCY", "A task that it waits for has not succeeded yet (depends_on), or not ended (same_robot_as).";
    WaitingForTime = "WAITING_FOR_TIME", "Its not_before lies ahead.";
    WaitingForHold = "WAITING_FOR_HOLD", "A hold token stands on the task. Resume it.";
    WaitingInQueue = "WAITING_IN_QUEUE", "Tasks of higher priority or age go first.";
    WaitingForAnswer = "WAITING_FOR_ANSWER", "The robot was offered it and has not answered yet. Without an answer the offer ends by itself.";
    WaitingForStop = "WAITING_FOR_STOP", "The robot was told to end it and has not confirmed that yet.";
    WorksOnStep = "WORKS_ON_STEP", "The robot works on a step of it.";
    WaitingForRetry = "WAITING_FOR_RETRY", "It failed and waits out its back-off.";
    DependencyFailed = "DEPENDENCY_FAILED", "A task it depends on ended without success, or the one of same_robot_as without having had a robot.";
    NoRobotAccepts = "NO_ROBOT_ACCEPTS", "It was offered five times in a row and refused each time.";
    NoRobotCan = "NO_ROBOT_CAN", "Every candidate refused it for its content; it cannot be done as asked.";
    AttemptsSpent = "ATTEMPTS_SPENT", "Every allowed attempt failed.";
    FaultNotRecoverable = "FAULT_NOT_RECOVERABLE", "The robot reported a fault that is never retried.";
    TaskFailed = "TASK_FAILED", "The attempt failed and the task asks for no retry.";
    ScheduleToStart = "SCHEDULE_TO_START", "No robot started it in time.";
    NoKnownRobot = "NO_KNOWN_ROBOT", "No known robot could ever do it, by what each last said of itself. Enrol or refit one and requeue it, or cancel it.";
    StartToClose = "START_TO_CLOSE", "The attempt took longer than the task's timeout.";
    Stalled = "STALLED", "The robot made no progress for too long.";
    DeadlinePassed = "DEADLINE_PASSED", "The task's deadline passed.";
    OfferNotAnswered = "OFFER_NOT_ANSWERED", "The robot did not answer the offer in time.";
    StopNotConfirmed = "STOP_NOT_CONFIRMED", "The robot did not confirm its stop. Its places stay taken until it reports or a person clears them.";
    LeaseOver = "LEASE_OVER", "The robot was not heard for longer than its authority.";
    StepUnknown = "STEP_UNKNOWN", "The robot restarted inside a step that must not be done twice.";
    UncertainTooLong = "UNCERTAIN_TOO_LONG", "Nobody could say for five minutes what the robot did. Places in which it may be stay closed until it is heard."
        => "Look at the robot, then `midshift task resolve TASK --as ANSWER --reason TEXT` and for each place that `midshift incident ls` names `midshift zone clear PLACE --reason TEXT --if-match ETAG`.";
    RobotDroppedIt = "ROBOT_DROPPED_IT", "The robot no longer has the attempt."
        => "If a place stays closed, `midshift incident ls` names it: look there, then `midshift zone clear PLACE --reason TEXT --if-match ETAG`.";
    Forced = "FORCED", "A person ended it by force; robot and places stay kept until the robot reports.";
    CanceledByPerson = "CANCELED_BY_PERSON", "A person or program canceled it.";
    Coalesced = "COALESCED", "A newer task with the same coalesce_key came before a robot had it, and is done in its place.";
    ResolvedByPerson = "RESOLVED_BY_PERSON", "A person resolved it.";
    DrainSuspend = "DRAIN_SUSPEND", "The robot is taken out of work; the task goes on with another.";
    SkippedBusy = "SKIPPED_BUSY", "The robot could not be had in time: a step that may not be interrupted, a load, or a task that may not wait. It works on.";
    BatterySuspend = "BATTERY_SUSPEND", "The robot goes to charge first.";
    UrgentSuspend = "URGENT_SUSPEND", "An urgent task takes the robot; this one goes on afterwards, with whichever robot is nearest.";
    // --- why a robot is left out of a roll-out
    SkippedOffline = "SKIPPED_OFFLINE", "The robot was not heard when its turn came. It is tried once more at the end.";
    SkippedStuck = "SKIPPED_STUCK", "The robot did not get as far as it should in time: its download, or what it needs to activate. It is tried once more at the end.";
    SkippedIncompatible = "SKIPPED_INCOMPATIBLE", "The bundle is not for a robot of this model.";
    SkippedPinned = "SKIPPED_PINNED", "A person keeps the robot at what it runs. Unpin it.";
    SkippedOtherKey = "SKIPPED_OTHER_KEY", "The robot shows another device key than before and was not enrolled since: it may be another machine."
        => "`midshift robot replace ROBOT` enrols its machine anew; `--accept-key` takes the key that it shows now.";
    SkippedExcluded = "SKIPPED_EXCLUDED", "A person left the robot out of this roll-out.";
    SkippedQuarantined = "SKIPPED_QUARANTINED", "The robot went back from this bundle before. Lift the quarantine.";
    SkippedRetired = "SKIPPED_RETIRED", "The robot was taken out of the fleet.";
    SkippedCurrent = "SKIPPED_CURRENT", "The robot keeps this bundle already.";
    RolloutEnded = "ROLLOUT_ENDED", "The roll-out ended before the robot's turn came.";
    // --- what a robot of a roll-out waits for
    BlockedByBudget = "BUDGET", "As many robots of the area as its rules allow are out of work."
        => "It goes on once one of them is back; the rules of the area may allow more.";
    BlockedByWindow = "WINDOW_CLOSED", "The area's maintenance window is closed, or the area is frozen."
        => "It goes on when the window opens; the rules of the area may open it now.";
    BlockedBySilence = "ROBOT_SILENT", "The robot is out of work for a roll-out and is not heard."
        => "Bring it back into reach. If it will not come, say so with `midshift rollout write-off`: until it is heard it counts in no budget then, and keeps its drain.";
    BlockedByWave = "WAITING_FOR_WAVE", "Its wave has not begun."
        => "It begins once the wave before is kept; `midshift rollout get` shows what that one does.";
    BlockedByTurnInWave = "WAITING_FOR_TURN_IN_WAVE", "As many robots as the roll-out allows are out of work for it."
        => "It goes on once one of them is decided.";
    BlockedByPause = "ROLLOUT_PAUSED", "The roll-out stands still."
        => "Resume it.";
    NoDirectiveKey = "NO_DIRECTIVE_KEY", "The server has no directive key of the newest set, so robots would refuse its orders and it signs none."
        => "Put a directive-*.pem that the set names into its folder of --ota-keys, or push a next set that names one it has; see docs/runbooks/keys.md.";
    BlockedByRollout = "WAITING_FOR_ROLLOUT", "Another roll-out has the robot."
        => "It goes on once that one has decided the robot; abort it to go on now.";
    BlockedByDownload = "WAITING_FOR_DOWNLOAD", "The robot fetches the bundle while it works."
        => "Look at its link and its rate if the download does not move on.";
    BlockedByDrain = "WAITING_FOR_DRAIN", "The robot ends its work and parks."
        => "`midshift robot explain` says what it does; after its time it works on and is passed over.";
    BlockedByRobot = "WAITING_FOR_ROBOT_READY", "The robot is parked and has not asked to activate: its charge, its temperature, a stop or its link."
        => "Look at the robot; after its time it works on and is passed over.";
    BlockedBySwitch = "WAITING_FOR_SWITCH", "The robot changes its software."
        => "Look at the robot if it is not heard again.";
    BlockedByProbation = "ON_PROBATION", "The robot runs the bundle and gets no work until its probation is over."
        => "It works then, or goes back by itself.";
    BlockedByGate = "WAITING_FOR_GATE", "The robot works with the bundle; its wave has not been judged."
        => "Give the wave work, or judge it: `midshift rollout promote` or `midshift rollout abort`.";
    BlockedByCommit = "WAITING_FOR_COMMIT", "The robot was told to keep the bundle and has not answered."
        => "Look at its link.";
    BlockedByRevert = "REVERT_PENDING", "The robot is to go back, and does before it works again."
        => "Look at the robot if it stands and does not.";
    // --- what counts against a bundle
    RobotLost = "ROBOT_LOST", "The robot was not heard again after it was given the bundle, and most others were.";
    RobotWentBack = "ROBOT_WENT_BACK", "The robot went back from the bundle by itself.";
    RollbackFailed = "ROLLBACK_FAILED", "The robot could not go back, and stays out of work."
        => "Mend its software, then `midshift robot unstick ROBOT --reason TEXT`; one that cannot be mended: retire it.";
    BreakerOnTrial = "BREAKER_ON_TRIAL", "The robot failed three attempts in ten minutes with the bundle.";
    JammedOnTrial = "JAMMED_ON_TRIAL", "The robot has work and has stood for five minutes with the bundle, while most others got on with theirs.";
    HardStopCode = "HARD_STOP_CODE", "A robot with the bundle reported a fault that its manifest names as one that ends the roll-out.";
    HardwareStopOnTrial = "HARDWARE_STOP_ON_TRIAL", "The maker's safety system stopped a robot within ten minutes of its change.";
    // --- verdicts on a roll-out
    GateProven = "GATE_PROVEN", "Enough robots did well to prove it.";
    GateUnproven = "GATE_UNPROVEN", "No robot failed, and too few were seen to prove it; the bound says how bad it may still be.";
    GateReverted = "GATE_REVERTED", "The robots of the wave are back.";
    GateInconclusive = "GATE_INCONCLUSIVE", "What was seen proves neither. A person must judge it.";
    GateAsksPerson = "GATE_ASKS_PERSON", "The roll-out asks a person at this gate.";
    NoExposure = "NO_EXPOSURE", "The robots of the wave did not get enough work in time to be judged.";
    FailureAmongFew = "FAILURE_AMONG_FEW", "A robot failed while fewer than ten were attempted.";
    TooManyFailed = "TOO_MANY_FAILED", "More robots failed than a good bundle lets fail.";
    RateTooHigh = "RATE_TOO_HIGH", "Robots with the bundle fail tasks at several times the rate of the others.";
    EffortTooHigh = "EFFORT_TOO_HIGH", "Robots with the bundle need more time, energy or heat for their work than the others, beyond what the roll-out lets pass. A person must judge it.";
    PromotedByPerson = "PROMOTED_BY_PERSON", "A person let it go on.";
    RetriedByPerson = "RETRIED_BY_PERSON", "A person tries the robot again.";
    AbortedByPerson = "ABORTED_BY_PERSON", "A person ended it.";
    SupersededBy = "SUPERSEDED_BY", "Another roll-out takes its place.";
    NewcomerFailed = "NEWCOMER_FAILED", "A robot that came after the roll-out was completed went back from its bundle. Robots that come later do not get it; roll it out anew, or retry the robot.";
    RolloutAborted = "ROLLOUT_ABORTED", "A roll-out was aborted. Its verdict has the numbers.";
    RolloutIncomplete = "ROLLOUT_INCOMPLETE", "A roll-out ended, and fewer of its robots have the bundle than its policy asks. Robots that come later do not get it. `midshift rollout report ID` says why; `midshift rollout retry ID --failed` tries the others again.";
    ContentRefused = "CONTENT_REFUSED", "Robots refused the bytes or the documents of a bundle, so its roll-out stands still; nothing bad runs. Look at the server's files and the repository, push what is damaged again, then resume the roll-out.";
    SoftwareDamaged = "SOFTWARE_DAMAGED", "A signed file on the server's disk was not what its release says, so it was handed out to nobody. Look at the disk, and push the release again.";
    // --- a robot's refusals and session answers
    StaleAuthority = "STALE_AUTHORITY", "The message reached the robot after its authority had ended, or was anchored to another session.";
    StaleEpoch = "STALE_EPOCH", "The robot has passed this epoch.";
    AlreadyFinished = "ALREADY_FINISHED", "The robot's ledger says the task is finished; the stored answer was sent.";
    InMaintenance = "IN_MAINTENANCE", "The robot is drained, changes its software or is on probation with it.";
    // --- software of a robot
    MetadataRefused = "METADATA_REFUSED", "What the repository says of its releases does not hold. Nothing was installed; look at the repository and its keys.";
    DirectiveRefused = "DIRECTIVE_REFUSED", "The robot did not take the order to change its software. Nothing was installed.";
    BadSignature = "BAD_SIGNATURE", "No key that the robot trusts has signed the order. Nothing was installed; look at the server's directive key and the set that names it.";
    BundleUnfit = "BUNDLE_UNFIT", "The bundle does not fit the robot: hardware, floor, what it needs or what it excludes.";
    BundleCorrupt = "BUNDLE_CORRUPT", "What was downloaded is not what was signed.";
    NoRoom = "NO_ROOM", "The robot has too little room on its disk for one more set.";
    BaseTooSoon = "BASE_TOO_SOON", "A new base takes the slot of the set before, which can then not be gone back to: the running set must have been kept for 24 hours first. A roll-out that still fills waves asks it again by itself; else order it again later.";
    MigrationDue = "MIGRATION_DUE", "The set is kept; its program still has to bring the robot's data to the new version.";
    MigrationFailed = "MIGRATION_FAILED", "The set is kept, but its program could not bring the robot's data to the new version. It is called again; look into the robot's log, or send a newer bundle.";
    ActivationBlocked = "ACTIVATION_BLOCKED", "The robot waits with its new software: it has work, a load, a stop, is in a passage, too hot or too low on charge.";
    ProgramCrashed = "PROGRAM_CRASHED", "The new program did not live; the launcher went back to the kept set.";
    SetPutAway = "SET_PUT_AWAY", "The set on trial no longer runs; the kept set does.";
    SelfTestFailed = "SELF_TEST_FAILED", "The body's own test failed with the new software.";
    LostServer = "LOST_SERVER", "With the new software the robot did not reach its server for ten minutes.";
    RevertAsked = "REVERT_ASKED", "The server asked the robot to go back.";
    NothingKept = "NOTHING_KEPT", "There is no set to go back to. A person must look.";
    RunningSetBad = "RUNNING_SET_BAD", "What the robot runs is not what was signed and committed: a file, a manifest or the record of what runs was changed on its disk. It takes no work, and has the bytes anew or goes back by itself; if it is stuck, a person must look at the machine.";
    KeptSetBad = "KEPT_SET_BAD", "The kept set is not whole. A person must look.";
    UnknownWaypoint = "UNKNOWN_WAYPOINT", "The robot's map has no such waypoint.";
    UnsupportedAction = "UNSUPPORTED_ACTION", "The robot's body cannot do this action.";
    NotAutomatic = "NOT_AUTOMATIC", "The robot is not in automatic mode.";
    AnotherHolder = "ANOTHER_HOLDER", "The robot's ledger already has a holder.";
    Fenced = "FENCED", "A newer session of this robot proved its succession.";
    ProtocolError = "PROTOCOL_ERROR", "A message broke the session's rules.";
    ClockRateMismatch = "CLOCK_RATE_MISMATCH", "The robot's clock rate differs from the server's.";
    ShuttingDown = "SHUTTING_DOWN", "The server is stopping." => "Come back soon.";
    MoveOver = "MOVE_OVER", "The session is old; open the next one before this one closes.";
    WatchUnread = "WATCH_UNREAD", "The watch had news and was not read for 30 s, so it has ended."
        => "Watch again, and read what comes.";
    Overflow = "OVERFLOW", "The robot's ring was full and thinned its oldest status.";
    FreedAfterAck = "FREED_AFTER_ACK", "The robot freed this range after it was acknowledged.";
    Poison = "POISON", "A sample could not be read; it was recorded, acknowledged and skipped.";
    RobotNotEnrolled = "ROBOT_NOT_ENROLLED", "A machine with a certificate of this site is not enrolled as this robot: the store was restored from a backup that is older than its enrolment, or another machine took its place. It is watched and gets no work."
        => "If it is yours, `midshift robot adopt ROBOT`. If not, find the machine: its certificate is not renewed, and ends within 7 days.";
    CloneSeen = "CLONE_SEEN", "Two sessions with one robot id were alive at once." => "Find the second machine.";
    StoreBehindRobot = "STORE_BEHIND_ROBOT", "The robot says that it has applied a newer generation than this store gave: the store was restored from a backup, or the robot errs.";
    TaskBacklog = "TASK_BACKLOG", "Ready tasks wait for a robot for more than an hour. It closes by itself. `midshift task ls --state queued` lists them.";
    RobotBreakerOpened = "ROBOT_BREAKER_OPENED", "A robot failed three attempts in ten minutes, and gets no work."
        => "Look at it, then `midshift robot uncordon ROBOT`.";
    PlaceBroken = "PLACE_BROKEN", "Three robots failed this action at this place within ten minutes, so no more are sent there for it. After ten minutes one task is let through as a probe, and its success closes the incident."
        => "Look there, put it right, then `midshift incident close INCIDENT --reason TEXT`.";
    PlaceBlocked = "PLACE_BLOCKED", "A person blocked this place: nobody is let in until the block ends."
        => "Wait for its end, or `midshift zone unblock PLACE --reason TEXT`.";
    PlaceQuarantined = "PLACE_QUARANTINED", "A place, or a seat of it, is kept closed until the robot that may be inside reports or a person clears it."
        => "Look there, then `midshift zone clear PLACE --reason TEXT --if-match ETAG`; `midshift zone ls` shows the ETAG.";
    HoldByPerson = "HOLD_BY_PERSON", "A person holds the task." => "`midshift task release TASK --reason TEXT` lets it go on.";
    HoldByStop = "HOLD_BY_STOP", "A fleet stop stopped the robot. Reset it, then resume what it held.";
    HoldByBody = "HOLD_BY_BODY", "The robot's own safety system stopped it.";
}

impl fmt::Display for Code {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.as_str())
    }
}

impl std::str::FromStr for Code {
    type Err = ();
    fn from_str(text: &str) -> Result<Self, ()> {
        Self::ALL.iter().copied().find(|c| c.as_str() == text).ok_or(())
    }
}
