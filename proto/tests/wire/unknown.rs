//! What becomes of a value of a newer version: each enum of the wire has a decision, and what is kept is passed on as it came.

use midshift_core::ids::{AttemptId, Subject};
use midshift_core::reason::{Code, Reason};
use midshift_core::robot::{Fault, FaultClass, ReportedAttempt, WorkState};
use midshift_proto::{common, link, parse};
use prost_reflect::DescriptorPool;
use std::collections::BTreeMap;

/// What a receiver does with a number that it does not know.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Fate {
    /// It is kept with its number, shown and passed on; nothing is freed, ended or moved forward by it.
    Kept,
    /// The message is not taken: a poison entry in a lane, elsewhere the end of the line that brought it. Nothing is freed or ended by it.
    NotTaken,
    /// A client asked for it: the request is refused and names the field.
    Refused,
    /// Only answers carry it: a client shows the number.
    Shown,
    /// An option in a .proto; no message carries it.
    Option,
}

const FATES: &[(&str, Fate)] = &[
    ("common.v1.DataClass", Fate::Option),
    ("common.v1.FaultClass", Fate::Kept),
    ("common.v1.LoadClass", Fate::Option),
    ("common.v1.Object", Fate::Option),
    ("common.v1.Permission", Fate::Option),
    ("common.v1.Purpose", Fate::Option),
    ("common.v1.Retention", Fate::Option),
    ("common.v1.StopLevel", Fate::NotTaken),
    ("fleet.v1.AssignmentPolicy", Fate::Refused),
    ("fleet.v1.DrainState", Fate::Shown),
    ("fleet.v1.Duty", Fate::Shown),
    ("fleet.v1.Errand", Fate::Shown),
    ("fleet.v1.PlaceHolderState", Fate::Shown),
    ("fleet.v1.PlaceKind", Fate::Shown),
    ("fleet.v1.PlaceRule", Fate::Shown),
    ("fleet.v1.RobotFree", Fate::Shown),
    ("fleet.v1.TaskClass", Fate::Shown),
    ("link.v1.CloseCode", Fate::NotTaken),
    ("link.v1.HardwareStop", Fate::NotTaken),
    ("link.v1.Lane", Fate::NotTaken),
    ("link.v1.Mode", Fate::NotTaken),
    ("link.v1.PlaceNews", Fate::NotTaken),
    ("link.v1.UpdateGoal", Fate::NotTaken),
    ("link.v1.UpdateState", Fate::NotTaken),
    ("link.v1.WorkEffect", Fate::NotTaken),
    ("link.v1.WorkState", Fate::Kept),
    ("ota.v1.AbortScope", Fate::Refused),
    ("ota.v1.Encoding", Fate::Refused),
    ("ota.v1.GateOutcome", Fate::Shown),
    ("ota.v1.RolloutOutcome", Fate::Shown),
    ("ota.v1.RolloutPause", Fate::Shown),
    ("ota.v1.RolloutPhase", Fate::Shown),
    ("ota.v1.RolloutStep", Fate::Shown),
    ("ota.v1.SmallWave", Fate::Refused),
    ("ota.v1.SmallWaveFailure", Fate::Refused),
    ("ota.v1.Suspicion", Fate::Shown),
    ("stop.v1.Confirmation", Fate::Shown),
    ("stop.v1.SilenceStage", Fate::NotTaken),
    ("task.v1.AttemptState", Fate::Shown),
    ("task.v1.OnFail", Fate::Refused),
    ("task.v1.Resolution", Fate::Refused),
    ("task.v1.StepEffect", Fate::Refused),
    ("task.v1.StopThen", Fate::Shown),
    ("task.v1.TaskState", Fate::Refused),
    ("telemetry.v1.Presence", Fate::Refused),
];

#[test]
fn every_enum_of_the_wire_has_a_decision_for_numbers_of_a_newer_version() {
    let pool = DescriptorPool::decode(midshift_proto::FILE_DESCRIPTOR_SET).expect("descriptors");
    let names = pool.all_enums().map(|e| e.full_name().to_owned());
    let ours: Vec<String> = names.filter_map(|name| name.strip_prefix("midshift.").map(str::to_owned)).collect();
    let missing: Vec<_> = ours.iter().filter(|name| !FATES.iter().any(|(known, _)| known == name)).collect();
    let gone: Vec<_> = FATES.iter().filter(|(known, _)| !ours.iter().any(|name| name == known)).collect();
    assert!(missing.is_empty() && gone.is_empty(), "no decision: {missing:?}, no enum: {gone:?}");
}

#[test]
fn a_reason_of_a_newer_version_is_read_with_its_name_and_passed_on_as_it_came() {
    let metadata = BTreeMap::from([("robot_id".to_owned(), "rbt-01".to_owned())]);
    let wire = common::v1::Reason { code: "GRAVITY_LOST_2".into(), message: "it floats".into(), metadata };
    let reason: Reason = parse(wire.clone()).expect("a reason of a newer version");
    assert_eq!((reason.code, reason.name()), (Code::Unknown, "GRAVITY_LOST_2"));
    assert_eq!(common::v1::Reason::from(&reason), wire);
    let row = serde_json::to_string(&reason).expect("a row");
    assert_eq!(serde_json::from_str::<Reason>(&row).expect("a reason"), reason);
}

#[test]
fn a_reason_without_a_name_or_with_one_that_is_no_name_is_refused() {
    for code in ["", "lower_case", "A B", "Ä", &"A".repeat(65)] {
        let wire = common::v1::Reason { code: code.into(), ..Default::default() };
        assert!(parse::<Reason, _>(wire).is_err(), "{code:?}");
    }
}

#[test]
fn an_attempt_in_a_state_of_a_newer_version_is_kept_by_its_number_and_is_not_over() {
    let attempt = AttemptId { subject: Subject::parse("T1").expect("an id"), epoch: 1 };
    let wire = link::v1::ReportedAttempt { attempt: Some((&attempt).into()), state: 99, ..Default::default() };
    let reported: ReportedAttempt = parse(wire.clone()).expect("a report");
    assert!(reported.state == WorkState::Unknown(99) && !reported.state.is_over());
    assert_eq!(link::v1::ReportedAttempt::from(&reported), wire);
    let row = serde_json::to_string(&reported).expect("a row");
    assert_eq!(serde_json::from_str::<ReportedAttempt>(&row).expect("a report"), reported);
    let unspecified = link::v1::ReportedAttempt { state: 0, ..wire };
    assert!(parse::<ReportedAttempt, _>(unspecified).is_err());
}

#[test]
fn a_fault_of_a_class_of_a_newer_version_is_kept_by_its_number() {
    let wire = common::v1::Fault { code: 7, fault_class: 99, message: "hot".into() };
    let fault: Fault = parse(wire.clone()).expect("a fault");
    assert_eq!((fault.class, common::v1::Fault::from(&fault)), (FaultClass::Unknown(99), wire));
    let row = serde_json::to_string(&fault).expect("a row");
    assert_eq!(serde_json::from_str::<Fault>(&row).expect("a fault"), fault);
}
