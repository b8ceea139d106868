//! Enums of core and their numbers on the wire.

use crate::{common, fleet, link, ota, stop, task, telemetry};
use midshift_core::fleet::projection::plans::Free;
use midshift_core::fleet::rows::{DrainState, HolderState};
use midshift_core::planner_policy::AssignmentPolicy;
use midshift_core::presence::Presence;
use midshift_core::robot::WorkState;
use midshift_core::robot::{Duty, FaultClass, HardwareStop, Lane, Mode, StopLevel};
use midshift_core::robot_events::PlaceNews;
use midshift_core::rollout::rows::{Ending, Outcome, Pause, Phase as RolloutPhase, Step as RolloutStep};
use midshift_core::rollout::spec::{AbortScope, SmallWave, SmallWaveFailure};
use midshift_core::step::Effect;
use midshift_core::stop::ladder::Stage;
use midshift_core::task::spec::Class;
use midshift_core::task::state::Errand;
use midshift_core::task::{AfterStopping, AttemptPhase, Phase, Resolution};
use midshift_core::update::{Goal, UpdateState};

/// A core enum with its twin on the wire.
pub trait WireEnum: Sized {
    /// Its number.
    fn to_wire(self) -> i32;
    /// None for UNSPECIFIED (unless the .proto gives it a meaning), and for numbers this build does not know where core has no `Unknown`.
    fn from_wire(number: i32) -> Option<Self>;
}

macro_rules! wire_enums {
    ($($core:ident = $wire:path { $($a:ident = $b:ident),* $(,)? } $(=> $unknown:ident)?)*) => {
        $(impl WireEnum for $core {
            fn to_wire(self) -> i32 {
                use $wire as W;
                match self { $(Self::$a => W::$b as i32,)* $(Self::$unknown(number) => number)? }
            }
            fn from_wire(number: i32) -> Option<Self> {
                use $wire as W;
                $(if number == W::$b as i32 { return Some(Self::$a); })*
                $(if number != 0 { return Some(Self::$unknown(number)); })?
                None
            }
        })*
        #[cfg(test)]
        mod tests {
            use super::*;

            #[test]
            fn every_enum_reads_back_and_every_number_but_zero_has_a_meaning() {
                $(
                    $(assert_eq!($core::from_wire($core::$a.to_wire()), Some($core::$a));)*
                    for number in 1..32 {
                        use $wire as W;
                        let read = $core::from_wire(number);
                        $(let read = read.filter(|value| !matches!(value, $core::$unknown(_)));)?
                        assert_eq!(W::try_from(number).is_ok(), read.is_some(), "{} {number}", stringify!($core));
                    }
                    $(assert_eq!($core::from_wire(99).map(WireEnum::to_wire), Some(99), "{}", stringify!($unknown));)?
                )*
            }
        }
    };
}

wire_enums! {
    FaultClass = common::v1::FaultClass { Recoverable = Recoverable, Mechanical = Mechanical, Stop = Stop, Semantic = Semantic } => Unknown
    Lane = link::v1::Lane { Critical = Critical, Event = Event, Status = Status }
    Mode = link::v1::Mode { Automatic = Automatic, Manual = Manual, Service = Service }
    StopLevel = common::v1::StopLevel { None = None, Slow = Slow, Halt = Halt, ControlledStopPosture = ControlledStopPosture }
    HardwareStop = link::v1::HardwareStop { None = None, Manual = Manual, AutoAck = AutoAck, Remote = Remote }
    Stage = stop::v1::SilenceStage { Heard = Heard, Slow = Slow, Stand = Stand }
    WorkState = link::v1::WorkState {
        Accepted = Accepted, Refused = Refused, Navigating = Navigating, Executing = Executing, Paused = Paused, Stopping = Stopping,
        Succeeded = Succeeded, Failed = Failed, Aborted = Aborted, Suspended = Suspended, StepUnknown = StepUnknown,
    } => Unknown
    PlaceNews = link::v1::PlaceNews { Entered = Entered, Left = Left, NotEntered = NotEntered }
    Effect = link::v1::WorkEffect { Repeatable = Repeatable, CheckFirst = CheckFirst, AtMostOnce = AtMostOnce }
    Goal = link::v1::UpdateGoal { None = Unspecified, Stage = Stage, Activate = Activate, Commit = Commit, Revert = Revert }
    UpdateState = link::v1::UpdateState {
        Directed = Directed, Downloading = Downloading, Staged = Staged, Switching = Switching, Probation = Probation, Trial = Trial,
        Committing = Committing, RollingBack = RollingBack, Committed = Committed, RolledBack = RolledBack, Refused = Refused, Stuck = Stuck,
    }
    Presence = telemetry::v1::Presence { Online = Online, Suspect = Suspect, Offline = Offline }
    AssignmentPolicy = fleet::v1::AssignmentPolicy { FifoNearest = FifoNearest, Rolling = Rolling }
    Class = fleet::v1::TaskClass { Urgent = Urgent, Normal = Normal, Background = Background }
    Free = fleet::v1::RobotFree { Now = Now, AfterErrand = AfterErrand, Soon = Soon }
    Duty = fleet::v1::Duty { InWork = InWork, Cordoned = Cordoned, BrokenOff = BrokenOff, Retired = Retired }
    RolloutPhase = ota::v1::RolloutPhase {
        Draft = Draft, Validated = Validated, Approved = Approved, Prefetching = Prefetching, Applying = Applying, Soaking = Soaking, Gate = Gate,
        Review = Review, Aborting = Aborting, RollingBack = RollingBack, Completed = Completed, Aborted = Aborted, Superseded = Superseded,
    }
    Pause = ota::v1::RolloutPause {
        Operator = Operator, Infrastructure = Infrastructure, InfrastructureUnknown = InfrastructureUnknown, Revoked = Revoked,
        Keyless = Keyless, Content = Content,
    }
    Ending = ota::v1::RolloutOutcome { Complete = Complete, Incomplete = Incomplete }
    Outcome = ota::v1::GateOutcome {
        Promoted = Promoted, PromotedUnproven = PromotedUnproven, PromotedByPerson = PromotedByPerson, Review = Review, Aborted = Aborted,
    }
    RolloutStep = ota::v1::RolloutStep {
        Waiting = Waiting, Staging = Staging, Staged = Staged, Draining = Draining, Activating = Activating, Trial = Trial,
        Committing = Committing, Reverting = Reverting, Committed = Committed, RolledBack = RolledBack, Skipped = Skipped, Stuck = Stuck,
    }
    SmallWave = ota::v1::SmallWave { Auto = Auto, Review = Review }
    SmallWaveFailure = ota::v1::SmallWaveFailure { Abort = Abort, Review = Review }
    AbortScope = ota::v1::AbortScope { All = All, Trial = Trial }
    Errand = fleet::v1::Errand { Charge = Charge, Park = Park }
    DrainState = fleet::v1::DrainState { Waiting = Waiting, Draining = Draining, Held = Held, Refused = Refused }
    HolderState = fleet::v1::PlaceHolderState { Granted = Granted, Inside = Inside, Revoking = Revoking }
    Phase = task::v1::TaskState {
        Queued = Queued, Assigned = Assigned, Running = Running, Held = Held, Suspended = Suspended, Stopping = Stopping,
        RetryWait = RetryWait, NeedsOperator = NeedsOperator, Succeeded = Succeeded, Failed = Failed, Canceled = Canceled, Expired = Expired,
    }
    AfterStopping = task::v1::StopThen {
        Canceled = Canceled, Failed = Failed, Retry = Retry, Suspended = Suspended, Requeue = Requeue, Expired = Expired,
        NeedsOperator = NeedsOperator,
    }
    AttemptPhase = task::v1::AttemptState {
        Offered = Offered, Accepted = Accepted, Navigating = Navigating, Executing = Executing, Paused = Paused, Stopping = Stopping,
        Refused = Refused, OfferExpired = OfferExpired, Succeeded = Succeeded, Failed = Failed, Aborted = Aborted, Lost = Lost,
        Docked = Docked,
    }
    Resolution = task::v1::Resolution {
        Requeue = Requeue, RequeueHandedOver = RequeueHandedOver, RequeuePutBack = RequeuePutBack, Succeeded = Succeeded, Failed = Failed,
        FailedItemLost = FailedItemLost, Canceled = Canceled,
    }
}

/// `TaskSpec`'s effects have the numbers of `WorkEffect`; a test holds them together.
pub(crate) fn step_effect(effect: Effect) -> i32 {
    effect.to_wire()
}

#[cfg(test)]
mod step_tests {
    use super::*;

    #[test]
    fn the_effects_of_a_spec_and_of_work_have_the_same_numbers() {
        for number in 0..=3 {
            let spec = task::v1::StepEffect::try_from(number).expect("known").as_str_name();
            let work = link::v1::WorkEffect::try_from(number).expect("known").as_str_name();
            assert_eq!(spec.strip_prefix("STEP_EFFECT_"), work.strip_prefix("WORK_EFFECT_"));
        }
    }
}
