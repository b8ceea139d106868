//! Robots and their events as callers see them.

use midshift_core::heartbeat::{ClockOffset, NewestHeartbeat};
use midshift_core::ids::{RobotId, SetId};
use midshift_core::presence::Presence;
use midshift_core::presence::PresenceRow;
use midshift_core::reason::Code;
use midshift_core::robot::{Inventory, Lane, Mode, ReportedState};
use midshift_core::robot_events::{Gap, InboxEntry, InboxItem};
use midshift_core::session::Session;
use midshift_core::time::{LinkTime, Now, SiteTime, Utc};
use midshift_core::update::{Installed, InstalledSet};
use midshift_proto::convert::telemetry::{RobotView, encode_event, encode_robot};
use midshift_proto::convert::{ms_of, time_of};
use midshift_proto::{link, telemetry::v1};
use std::collections::BTreeMap;

fn robot() -> RobotId {
    RobotId::parse("rbt-01").expect("id")
}

fn installed() -> Installed {
    let set = |name: &str| SetId::parse(name).expect("id");
    let one = InstalledSet {
        set: set("11"),
        bundle: None,
        version: "walk 1.5.0".into(),
        components: BTreeMap::from([("gait".into(), "1.4.0".into())]),
        components_left_out: 0,
    };
    Installed {
        robot_id: robot(),
        boot_id: "b".into(),
        device_key: "ab".repeat(32),
        model: "h-1".into(),
        free_bytes: 7,
        running: set("22"),
        current: set("11"),
        previous: Some(set("factory")),
        sets: vec![one],
    }
}

#[test]
fn a_robot_shows_how_old_its_report_is_and_the_measured_clock_before_the_remembered_one() {
    let session = Session {
        secret: "s3cret".into(),
        clock_offset_ms: Some(-3),
        installed: Some(installed()),
        device_key: Some("ab".repeat(32)),
        device_key_changed: true,
        ..Session::new(robot(), 7, Inventory::default())
    };
    let presence = PresenceRow::new(robot(), Presence::Suspect, 4_000);
    let live = NewestHeartbeat {
        robot_id: robot(),
        report: ReportedState { hb: 9, mode: Mode::Manual, ..ReportedState::default() },
        processed_at: LinkTime(1_000),
        processed_site: SiteTime(1_000),
        received_unix_ms: 3_500,
        progress_at: SiteTime(0),
        clock: Some(ClockOffset { clock_offset_ms: 12, clock_error_ms: 2 }),
    };
    let durable = BTreeMap::from([(Lane::Event, 5)]);
    let id = robot();
    let view = RobotView {
        robot_id: &id,
        presence: Some(&presence),
        session: Some(&session),
        live: Some(&live),
        area_id: None,
        durable: &durable,
        observed_since: Some(Utc(2_000)),
    };
    let now = Now { link: LinkTime(5_250), ..Now::default() };
    let wire = encode_robot(view, now);
    assert_eq!((wire.presence(), wire.session_epoch, wire.observed), (v1::Presence::Suspect, 7, true));
    assert_eq!(wire.observed_since.as_ref().map(|t| t.seconds), Some(2));
    assert_eq!(wire.age.as_ref().map(ms_of), Some(4_250));
    assert_eq!((wire.clock_offset_ms, wire.clock_error_ms), (Some(12), Some(2)));
    assert_eq!(wire.reported.as_ref().expect("report").mode(), link::v1::Mode::Manual);
    let shown = wire.installed.as_ref().expect("installed");
    assert_eq!((shown.running.as_str(), shown.previous.as_str(), shown.free_bytes), ("22", "factory", 7));
    assert_eq!((shown.current.as_str(), shown.sets[0].version.as_str()), ("11", "walk 1.5.0"));
    assert_eq!(shown.sets[0].components.get("gait").map(String::as_str), Some("1.4.0"));
    assert_eq!((wire.device_key.len(), wire.device_key_changed), (64, true));
    assert!(!format!("{wire:?}").contains("s3cret"), "the secret of a session is shown to nobody");

    let wire = encode_robot(RobotView { live: None, presence: None, observed_since: None, ..view }, now);
    assert_eq!((wire.presence(), wire.clock_offset_ms, wire.observed), (v1::Presence::Offline, Some(-3), false));
    assert!(wire.reported.is_none() && wire.age.is_none());
}

#[test]
fn an_event_keeps_its_name_of_ring_lane_and_number() {
    let entry = |what| InboxEntry {
        robot_id: robot(),
        session_epoch: 7,
        ring: "ring-a".into(),
        lane: Lane::Event,
        what,
        stamp_in_future: true,
    };
    let gap = Gap { lane: Lane::Event, from_seq: 3, to_seq: 5, reason: Code::Overflow.into() };
    let wire = encode_event(&entry(InboxItem::Gap(gap)), Utc(1_234), "store-1:9".into());
    assert_eq!((wire.ring.as_str(), wire.lane(), wire.cursor.as_str()), ("ring-a", link::v1::Lane::Event, "store-1:9"));
    assert_eq!((wire.receive_time.as_ref().map(time_of), wire.stamp_in_future), (Some(Utc(1_234)), true));
    let wire = encode_event(&entry(InboxItem::Poison { seq: 8, detail: "no body".into() }), Utc(0), String::new());
    let Some(v1::event::Item::Poison(poison)) = wire.item else { panic!("not poison") };
    let reason = poison.reason.expect("reason");
    assert_eq!((poison.seq, reason.code.as_str(), reason.message.as_str()), (8, "POISON", "no body"));
}
