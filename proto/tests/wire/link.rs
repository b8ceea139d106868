//! The link there and back: what core says is what the other end hears.

use midshift_core::authority::Authority;
use midshift_core::desired_state::{
    AreaRules, Assignment, DesiredPolicy, DesiredWork, GrantedPlace, LoadWord, RoutePoint,
};
use midshift_core::ids::{
    AreaId, AttemptId, BundleId, DrainId, PlaceId, RobotId, SetId, StopId, Subject, TaskId, WaypointId,
};
use midshift_core::limits;
use midshift_core::policy::AreaPolicy;
use midshift_core::reason::{Code, Reason};
use midshift_core::robot::WorkState;
use midshift_core::robot::{
    Fault, FaultClass, HardwareStop, HeldPlace, Inventory, Lane, Load, Mode, Pose, ReportedAttempt, ReportedState,
    StopLevel, Vitals,
};
use midshift_core::robot_events::{
    AttemptReport, Gap, InboxItem, PlaceNews, RobotEvent, Sample, SampleBody, WorkStats,
};
use midshift_core::step::{Effect, StepKind, WorkStep};
use midshift_core::stop::{Reset, Scope, Stop};
use midshift_core::time::Utc;
use midshift_core::update::{ActivationGrant, DesiredUpdate, Goal, UpdateEvent, UpdateReport, UpdateState};
use midshift_proto::link::v1;
use midshift_proto::parse;
use midshift_proto::session::{
    ClockSample, Close, CloseCode, Downlink, Echo, FromRobot, Heartbeat, Hello, LaneAck, LaneBatch, LanePosition,
    Previous, StatusReplay, StopFacts, ToRobot, Uplink, Welcome,
};
use proptest::prelude::*;
use prost::Message;
use std::collections::BTreeMap;

fn robot() -> RobotId {
    RobotId::parse("rbt-01").expect("id")
}
fn place(name: &str) -> PlaceId {
    PlaceId::parse(name).expect("id")
}
fn waypoint(name: &str) -> WaypointId {
    WaypointId::parse(name).expect("id")
}
fn attempt() -> AttemptId {
    AttemptId { subject: Subject::Task(TaskId::parse("TASK-20260601-AAAAAAAAAA").expect("id")), epoch: 3 }
}
fn errand() -> AttemptId {
    AttemptId { subject: Subject::Errand { robot_id: robot(), number: 17 }, epoch: 1 }
}
fn authority() -> Authority {
    Authority { session_epoch: 1_780_300_000_000, hb: 812, valid_ms: 5_000 }
}
fn fault() -> Fault {
    Fault { code: 1001, class: FaultClass::Recoverable, message: "obstacle".into() }
}
fn vitals() -> Vitals {
    Vitals {
        pose: Some(Pose { x_mm: -12_345, y_mm: 6_789, theta_mrad: -3142 }),
        waypoint: Some(waypoint("A01")),
        speed_mm_s: 900,
        battery_permille: 734,
        charging: true,
        hottest_joint_decidegrees: 412,
        odometer_mm: 123_456_789,
        loaded_odometer_mm: 45_678_901,
        energy_mwh: 98_765,
    }
}

/// A heartbeat of a robot at work, with nothing out of the ordinary.
fn at_work() -> ReportedState {
    ReportedState {
        hb: 812,
        session_epoch: 1_780_300_000_000,
        applied_work: 1_780_300_512_345,
        applied_policy: 1_780_300_000_001,
        produced: BTreeMap::from([(Lane::Critical, 3), (Lane::Event, 4_711), (Lane::Status, 86_400)]),
        mode: Mode::Automatic,
        vitals: vitals(),
        load: Some(Load { task_id: attempt().subject.task_id().cloned(), item: "SKU-88231".into() }),
        attempts: vec![ReportedAttempt {
            attempt: attempt(),
            state: WorkState::Navigating,
            step_index: 2,
            progress: 99,
            route_index: 4,
            opened: true,
        }],
        places: vec![HeldPlace { place_id: place("hold-7"), grant_id: 1_234, inside: true }],
        ..ReportedState::default()
    }
}

/// Everything that can be said at once.
fn reported() -> ReportedState {
    ReportedState {
        mode: Mode::Service,
        stop_level: StopLevel::ControlledStopPosture,
        stops: vec![stop_id()],
        awaiting_resume: vec![stop_id(), stop_id()],
        map_version: "2026-11".to_owned(),
        free_bytes: Some(64 << 30),
        hardware_stop: HardwareStop::Remote,
        field_violation: true,
        applied_update: 3,
        update: Some(update_report()),
        fault: Some(fault()),
        ..at_work()
    }
}

fn events() -> Vec<RobotEvent> {
    let report = AttemptReport {
        attempt: errand(),
        state: WorkState::Refused,
        step_index: 1,
        opened: true,
        refusal: Some(Reason::new(Code::StaleAuthority, "12 s too late").with("late_ms", 12_000)),
        fault: Some(fault()),
        stats: WorkStats {
            path_mm: 1,
            loaded_path_mm: 2,
            duration_ms: 3,
            energy_mwh: 4,
            hottest_joint_decidegrees: -5,
        },
    };
    vec![
        RobotEvent::Attempt(report),
        RobotEvent::Place { place_id: place("door-1"), grant_id: 9, news: PlaceNews::NotEntered },
        RobotEvent::Fault { fault: fault(), cleared: true },
        RobotEvent::Mode(Mode::Manual),
        RobotEvent::HardwareStop(HardwareStop::None),
        RobotEvent::Load(None),
        RobotEvent::Load(Some(Load { task_id: None, item: "box".into() })),
        RobotEvent::StaleAuthority { what: "offer".into(), detail: "late".into() },
        RobotEvent::BatteryCritical { battery_permille: 49 },
        RobotEvent::FleetStop { level: StopLevel::None, stops: vec![], awaiting_resume: vec![] },
        RobotEvent::FleetStop { level: StopLevel::Halt, stops: vec![stop_id()], awaiting_resume: vec![stop_id()] },
        RobotEvent::Update(UpdateEvent::Changed(update_report())),
        RobotEvent::Update(UpdateEvent::DirectiveRefused { generation: 7, reason: Code::DirectiveRefused.into() }),
        RobotEvent::Update(UpdateEvent::Ready { drain_id: drain(), set: set() }),
    ]
}

fn stop_id() -> StopId {
    StopId::parse("STOP-20260601-ABCDEFGHJK").expect("id")
}

fn drain() -> DrainId {
    DrainId::parse("op:drain-1").expect("id")
}

fn set() -> SetId {
    SetId::parse("factory").expect("id")
}

fn update_report() -> UpdateReport {
    UpdateReport {
        state: UpdateState::RollingBack,
        bundle: BundleId::parse(&"ab".repeat(32)).expect("id"),
        directive_generation: 11,
        set: Some(set()),
        drain_id: Some(drain()),
        grant_id: 12,
        tries: 2,
        progress_permille: 1_000,
        reason: Some(Reason::new(Code::SelfTestFailed, "the left knee").with("fault_code", 5_001)),
    }
}

fn desired_update() -> DesiredUpdate {
    DesiredUpdate {
        robot_id: robot(),
        generation: 9,
        goal: Goal::Activate,
        directive: "{}".into(),
        drain_id: Some(drain()),
        grant: Some(ActivationGrant { grant_id: 13, drain_id: drain(), authority: authority() }),
        rate_bytes_s: 250_000,
        probation_ms: 180_000,
    }
}

fn work() -> DesiredWork {
    let params = serde_json::json!({"item": "SKU-1", "n": 3, "weight": 1.25, "tags": ["a", null, true]});
    let step = |kind, effect| WorkStep {
        kind,
        effect,
        pause_allowed: true,
        cancel_allowed: false,
        timeout_ms: Some(30_000),
        continue_on_fail: true,
    };
    let point = |name: &str, ends_step, standing: Option<&str>| RoutePoint {
        waypoint: waypoint(name),
        x_mm: -5,
        y_mm: 7,
        ends_step,
        standing: standing.map(place),
        passages: vec![place("door-1"), place("aisle-2")],
        speed_limit_mm_s: Some(600),
        area_id: AreaId::parse("hall").expect("id"),
    };
    DesiredWork {
        robot_id: robot(),
        generation: 1_780_300_512_346,
        assignment: Some(Assignment {
            attempt: attempt(),
            offer: authority(),
            timeout_ms: 285_000,
            steps: vec![
                step(StepKind::Goto { waypoint: waypoint("A01") }, Effect::Repeatable),
                step(
                    StepKind::Action { name: "pick".into(), params: params.as_object().expect("object").clone() },
                    Effect::AtMostOnce,
                ),
                step(StepKind::Wait { duration_ms: 0 }, Effect::CheckFirst),
            ],
            from_step: 1,
            resume_step: 2,
            route_number: 4,
            route: vec![point("A00", None, None), point("A01", Some(0), Some("A01"))],
            released_index: Some(0),
            stop: true,
            suspend: true,
            speed_limit_mm_s: Some(450),
        }),
        grants: vec![
            GrantedPlace { place_id: place("A01"), grant_id: 5, entry: Some(authority()) },
            GrantedPlace { place_id: place("A00"), grant_id: 0, entry: None },
        ],
        held: true,
        resume: Some(authority()),
        closed: vec![attempt(), errand()],
        maintenance: Some(drain()),
        resumed: vec![stop_id(), stop_id()],
        load_word: Some(LoadWord { session_epoch: 7, hb: 40 }),
    }
}

fn policy() -> DesiredPolicy {
    let hall = AreaRules {
        speed_limit_mm_s: Some(800),
        avoidance_distance_mm: Some(1_200),
        without_people: true,
        ..AreaPolicy::default_of(AreaId::parse("hall").expect("id")).into()
    };
    DesiredPolicy {
        robot_id: robot(),
        generation: 12,
        areas: vec![hall, AreaPolicy::default_of(AreaId::parse("yard").expect("id")).into()],
    }
}

fn hello() -> Hello {
    Hello {
        robot_id: robot(),
        boot_id: "b-1".into(),
        previous: Some(Previous { session_epoch: 7, secret: "s3cret".into() }),
        inventory: Inventory {
            capabilities: vec!["pick".into(), "place".into()],
            labels: BTreeMap::from([("floor".into(), "1".into())]),
            payload_g: 15_000,
            software: "1.4.0".into(),
            agent_version: "0.1.0".into(),
            model: "h-1".into(),
            load_by_memory: true,
        },
        reported: ReportedState { hb: 0, session_epoch: 0, ..reported() },
        ring: "ring-a".into(),
        lanes: BTreeMap::from([
            (Lane::Event, LanePosition { first_seq: 4, next_seq: 4 }),
            (Lane::Status, LanePosition { first_seq: 1, next_seq: 90 }),
        ]),
        store_id: "store-1".into(),
        sent_unix_ms: 1_780_300_000_123,
        clock_rate_permille: 20_000,
        protocol_versions: vec![1],
        installed: "{\"payloadType\":\"…\"}".into(),
    }
}

fn clock() -> ClockSample {
    ClockSample {
        t1_us: 1_780_300_000_000_001,
        t2_us: 1_780_300_000_000_400,
        t3_us: 1_780_300_000_000_500,
        t4_us: 1_780_300_000_000_900,
    }
}

/// Through bytes, as on the wire.
fn up(message: &FromRobot) -> Result<FromRobot, midshift_core::reason::Refusal> {
    let bytes = v1::SessionRequest::from(message).encode_to_vec();
    parse(v1::SessionRequest::decode(bytes.as_slice()).expect("bytes"))
}

fn down(message: &ToRobot) -> Result<ToRobot, midshift_core::reason::Refusal> {
    let bytes = v1::SessionResponse::from(message).encode_to_vec();
    parse(v1::SessionResponse::decode(bytes.as_slice()).expect("bytes"))
}

fn uplink(lane: Lane, items: Vec<InboxItem>) -> FromRobot {
    FromRobot::Uplink(Uplink { heartbeat: None, batches: vec![LaneBatch { lane, items }] })
}

#[test]
fn what_a_robot_says_is_what_the_server_hears() {
    let items = events().into_iter().zip(1..);
    let mut items: Vec<_> = items
        .map(|(e, seq)| InboxItem::Sample(Sample { seq, robot_unix_ms: -1, body: SampleBody::Event(e) }))
        .collect();
    items.push(InboxItem::Gap(Gap { lane: Lane::Event, from_seq: 15, to_seq: 16, reason: Code::Overflow.into() }));
    let status = Sample { seq: 17, robot_unix_ms: 1_780_300_000_000, body: SampleBody::Status(vitals()) };
    let messages = [
        FromRobot::Hello(Box::new(hello())),
        FromRobot::Hello(Box::new(Hello {
            previous: None,
            reported: ReportedState::default(),
            lanes: BTreeMap::new(),
            installed: String::new(),
            ..hello()
        })),
        FromRobot::Uplink(Uplink {
            heartbeat: Some(Heartbeat { reported: reported(), sent_unix_us: 5, clock: Some(clock()) }),
            batches: vec![],
        }),
        FromRobot::Uplink(Uplink::default()),
        uplink(Lane::Event, items),
        uplink(Lane::Status, vec![InboxItem::Sample(status)]),
    ];
    for message in &messages {
        assert_eq!(up(message).as_ref(), Ok(message));
    }
}

#[test]
fn what_the_server_says_is_what_a_robot_hears() {
    let welcome = Welcome {
        session_epoch: 1_780_300_000_000,
        session_secret: "s3cret".into(),
        store_id: "store-1".into(),
        acks: vec![LaneAck { lane: Lane::Status, seq: 80, expect: None }],
        heartbeat_period_ms: 1_000,
        status_period_ms: 3_000,
        authority_ms: 30_000,
        status_credit_bytes: 65_536,
        protocol_version: 1,
        clock_rate_permille: 1_000,
        observed: true,
    };
    let full = Downlink {
        echo: Some(Echo { hb: 812, clock: ClockSample { t4_us: 0, ..clock() }, is_clock_doubted: true }),
        acks: vec![LaneAck { lane: Lane::Critical, seq: 0, expect: Some(1) }],
        work: Some(work()),
        unreadable_work: None,
        policy: Some(policy()),
        status_credit_bytes: Some(0),
        update: Some(desired_update()),
        stops: Some(stop_facts()),
        unreadable_stops: None,
    };
    let idle = DesiredWork { assignment: None, grants: vec![], held: false, resume: None, closed: vec![], ..work() };
    let close = Close {
        code: CloseCode::TooSlow,
        reason: Reason::new(Code::Overloaded, "reads nothing"),
        retry_after_ms: 60_000,
    };
    let messages = [
        ToRobot::Welcome(welcome),
        ToRobot::Downlink(Box::new(full)),
        ToRobot::Downlink(Box::new(Downlink { work: Some(idle), ..Downlink::default() })),
        ToRobot::Close(close),
        ToRobot::MoveOver { within_ms: 5_000 },
    ];
    for message in &messages {
        assert_eq!(down(message).as_ref(), Ok(message));
    }
}

fn stop_facts() -> StopFacts {
    let (stop_id, actor, reason) =
        (StopId::parse("STOP-1").expect("id"), "anna".to_owned(), "a pallet fell".to_owned());
    let engaged = Stop::new(stop_id.clone(), Scope::Fleet, StopLevel::Halt, Utc(5));
    let stop = Stop { actor: actor.clone(), reason: reason.clone(), proof: vec![1; 64], ..engaged };
    let reset = Reset { actor, reason, proof: vec![2; 64], ..Reset::new(stop_id, Utc(6)) };
    StopFacts { stops: vec![stop], resets: vec![reset] }
}

#[test]
fn a_heartbeat_with_nothing_new_takes_at_most_256_bytes() {
    let heartbeat = Heartbeat { reported: at_work(), sent_unix_us: clock().t1_us, clock: Some(clock()) };
    let message = FromRobot::Uplink(Uplink { heartbeat: Some(heartbeat), batches: vec![] });
    let bytes = v1::SessionRequest::from(&message).encoded_len();
    assert!(bytes <= 256, "{bytes} bytes");
}

#[test]
fn a_sample_nobody_can_read_becomes_poison_and_its_neighbours_stay() {
    let good =
        v1::Sample::from(&Sample { seq: 1, robot_unix_ms: 0, body: SampleBody::Event(RobotEvent::Mode(Mode::Manual)) });
    let unknown = v1::Sample { seq: 2, robot_unix_ms: 0, body: None };
    let mode = v1::robot_event::Event::Mode(v1::ModeReport { mode: 0 });
    let unspecified = v1::Sample {
        seq: 3,
        robot_unix_ms: 0,
        body: Some(v1::sample::Body::Event(v1::RobotEvent { event: Some(mode) })),
    };
    let wrong_lane = v1::Sample { seq: 4, robot_unix_ms: 0, body: Some(v1::sample::Body::Status((&vitals()).into())) };
    let batch = v1::LaneBatch {
        lane: v1::Lane::Event.into(),
        samples: vec![good, unknown, unspecified, wrong_lane],
        gaps: vec![],
    };
    let read: LaneBatch = parse(batch).expect("readable");
    let poison: Vec<_> = read
        .items
        .iter()
        .map(|item| match item {
            InboxItem::Poison { seq, detail } => (*seq, detail.clone()),
            InboxItem::Sample(sample) => (sample.seq, String::new()),
            InboxItem::Gap(gap) => (gap.from_seq, "gap".into()),
        })
        .collect();
    assert_eq!(poison[0], (1, String::new()));
    for (seq, word) in [(2, "body"), (3, "UNSPECIFIED"), (4, "lane STATUS")] {
        let (number, detail) = &poison[seq - 1];
        assert!(*number == seq as u64 && detail.contains(word), "{seq}: {detail}");
    }
}

#[test]
fn samples_and_gaps_of_a_batch_are_read_in_the_order_of_their_numbers() {
    let sample = |seq| InboxItem::Sample(Sample { seq, robot_unix_ms: 0, body: SampleBody::Status(Vitals::default()) });
    let gap =
        |from_seq, to_seq| InboxItem::Gap(Gap { lane: Lane::Status, from_seq, to_seq, reason: Code::Overflow.into() });
    let message = uplink(Lane::Status, vec![gap(1, 4), sample(5), gap(6, 6), sample(7)]);
    assert_eq!(up(&message), Ok(message));
}

#[test]
fn a_gap_ends_where_numbers_can_be_counted_on() {
    let to = |to_seq| {
        let gap = Gap { lane: Lane::Event, from_seq: 1, to_seq, reason: Code::Overflow.into() };
        up(&uplink(Lane::Event, vec![InboxItem::Gap(gap)]))
    };
    assert!(to(limits::COUNTED_MAX - 1).is_ok());
    for last in [limits::COUNTED_MAX, u64::MAX] {
        let refusal = to(last).expect_err("no Hello can say the number that comes after it");
        assert_eq!(refusal.violations[0].field, "uplink.batches[0].gaps[0].to_seq");
    }
}

#[test]
fn a_session_that_breaks_the_shape_hears_every_field() {
    let wrong = v1::Hello {
        inventory: Some(v1::Inventory { capabilities: vec!["Pick up".into()], ..Default::default() }),
        ..Default::default()
    };
    let request = v1::SessionRequest { message: Some(v1::session_request::Message::Hello(wrong)) };
    let refusal = parse::<FromRobot, _>(request).expect_err("invalid");
    let fields: Vec<_> = refusal.violations.iter().map(|v| v.field.as_str()).collect();
    let wanted = [
        "robot_id",
        "boot_id",
        "inventory.capabilities",
        "reported",
        "ring",
        "clock_rate_permille",
        "protocol_versions",
    ];
    assert_eq!(fields, wanted.map(|f| format!("hello.{f}")));
    let zero = Heartbeat { reported: ReportedState { hb: 0, ..at_work() }, sent_unix_us: 0, clock: None };
    assert!(up(&FromRobot::Uplink(Uplink { heartbeat: Some(zero), batches: vec![] })).is_err());
    assert!(parse::<FromRobot, _>(v1::SessionRequest { message: None }).is_err());
}

#[test]
fn a_robot_that_says_nothing_of_what_stops_it_is_refused() {
    let silent = v1::ReportedState { stop_level: 0, hardware_stop: 0, ..(&reported()).into() };
    let refusal = parse::<ReportedState, _>(silent).expect_err("silence is no word");
    let fields: Vec<&str> = refusal.violations.iter().map(|v| v.field.as_str()).collect();
    assert_eq!(fields, ["stop_level", "hardware_stop"]);
    let free = ReportedState { stop_level: StopLevel::None, hardware_stop: HardwareStop::None, ..reported() };
    assert_eq!(parse::<ReportedState, _>(v1::ReportedState::from(&free)), Ok(free));
}

#[test]
fn a_hello_with_more_of_what_is_installed_than_may_be_is_refused() {
    let with = |installed: String| up(&FromRobot::Hello(Box::new(Hello { installed, ..hello() })));
    assert!(with("x".repeat(limits::INSTALLED_BYTES_MAX)).is_ok());
    let refusal = with("x".repeat(limits::INSTALLED_BYTES_MAX + 1)).expect_err("too much");
    assert_eq!(refusal.violations[0].field, "hello.installed");
}

#[test]
fn an_uplink_over_its_limit_is_refused() {
    let sample = |seq| InboxItem::Sample(Sample { seq, robot_unix_ms: 0, body: SampleBody::Status(Vitals::default()) });
    assert!(up(&uplink(Lane::Status, (1..=256).map(sample).collect())).is_ok());
    assert!(up(&uplink(Lane::Status, (1..=257).map(sample).collect())).is_err());
}

#[test]
fn a_release_beyond_the_route_never_reaches_a_body() {
    let mut wire = v1::DesiredWork::from(&work());
    let assignment = wire.assignment.as_mut().expect("assignment");
    assignment.released_index = Some(2);
    let refusal = parse::<DesiredWork, _>(wire).expect_err("invalid");
    assert!(refusal.violations[0].description.contains("released_index"));
}

proptest! {
    #[test]
    fn vitals_come_back_whatever_their_numbers(
        pose in proptest::option::of((any::<i32>(), any::<i32>(), -3142i32..=3142)),
        battery_permille in 0u16..=1000,
        numbers in any::<(u32, bool, i32, u64, u64, u64)>(),
    ) {
        let vitals = Vitals {
            pose: pose.map(|(x_mm, y_mm, theta_mrad)| Pose { x_mm, y_mm, theta_mrad }),
            waypoint: None,
            speed_mm_s: numbers.0,
            battery_permille,
            charging: numbers.1,
            hottest_joint_decidegrees: numbers.2,
            odometer_mm: numbers.3,
            loaded_odometer_mm: numbers.4,
            energy_mwh: numbers.5,
        };
        let bytes = v1::Vitals::from(&vitals).encode_to_vec();
        prop_assert_eq!(parse::<Vitals, _>(v1::Vitals::decode(bytes.as_slice()).expect("bytes")), Ok(vitals));
    }

    #[test]
    fn bytes_of_any_kind_never_break_the_reader(bytes in proptest::collection::vec(any::<u8>(), 0..300)) {
        if let Ok(wire) = v1::SessionRequest::decode(bytes.as_slice()) {
            let _ = parse::<FromRobot, _>(wire);
        }
        if let Ok(wire) = v1::SessionResponse::decode(bytes.as_slice()) {
            let _ = parse::<ToRobot, _>(wire);
        }
    }
}

fn status_replay(seqs: std::ops::RangeInclusive<u64>) -> StatusReplay {
    let sample = |seq| InboxItem::Sample(Sample { seq, robot_unix_ms: 7, body: SampleBody::Status(vitals()) });
    let batch = LaneBatch { lane: Lane::Status, items: seqs.map(sample).collect() };
    StatusReplay { robot_id: robot(), session_epoch: 1_780_300_000_000, session_secret: "secret".into(), batch }
}

#[test]
fn old_status_and_its_answer_are_heard_as_they_were_said() {
    let replay = status_replay(1..=256);
    assert_eq!(parse(v1::ReplayStatusRequest::from(&replay)), Ok(replay));
    for expect in [None, Some(8)] {
        let ack = LaneAck { lane: Lane::Status, seq: 7, expect };
        assert_eq!(parse(v1::ReplayStatusResponse::from(&ack)), Ok(ack));
    }
    let other_lane = LaneAck { lane: Lane::Event, seq: 7, expect: None };
    assert!(parse::<LaneAck, _>(v1::ReplayStatusResponse::from(&other_lane)).is_err());
    assert!(parse::<LaneAck, _>(v1::ReplayStatusResponse { ack: None }).is_err());
}

#[test]
fn a_replay_that_breaks_the_shape_hears_every_field() {
    let heard = |request: v1::ReplayStatusRequest| {
        let refusal = parse::<StatusReplay, _>(request).expect_err("invalid");
        refusal.violations.into_iter().map(|v| v.field).collect::<Vec<_>>()
    };
    let nothing = v1::ReplayStatusRequest::default();
    assert_eq!(heard(nothing), ["robot_id", "session_epoch", "session_secret", "batch"]);
    let good = v1::ReplayStatusRequest::from(&status_replay(1..=1));
    for many in [0, 257] {
        assert_eq!(heard((&status_replay(1..=many)).into()), ["batch"]);
    }
    let events = v1::LaneBatch { lane: v1::Lane::Event.into(), ..good.batch.clone().expect("is there") };
    assert_eq!(heard(v1::ReplayStatusRequest { batch: Some(events), ..good }), ["batch.lane"]);
}
