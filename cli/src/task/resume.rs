//! `midshift resume`: robots and tasks that stand held go on.
//!
//! Invariant: a name of a stop is looked up among those that hold robots. None of these names begins another one, so what one alone begins with is that one.

use super::target::TaskTarget;
use crate::client::{Call, Change, Exit, unary};
use crate::lookup::{self, Found, whole_id};
use crate::out::Out;
use crate::robot;
use crate::robot_target::find_robot;
use midshift_core::fleet::stops::Hold;
use midshift_core::ids::StopId;
use midshift_proto::fleet::v1::RobotControl;
use midshift_proto::task::v1;
use std::collections::BTreeMap;

/// Who goes on.
#[derive(clap::Args)]
pub struct Resume {
    #[command(flatten)]
    call: Call,
    /// The stop that stood them, or a prefix that only one stop has of those that hold robots. It must be reset first.
    #[arg(long = "stop", visible_alias = "stop-id", value_name = "ID", default_value = "")]
    stop_id: String,
    /// Everything in this area.
    #[arg(long, default_value = "")]
    area: String,
    /// These robots, each by its id or a prefix that only one robot has.
    #[arg(long)]
    robot: Vec<String>,
    /// These tasks, each by its id or a prefix that only one task has.
    task_ids: Vec<String>,
    /// Why they may go on.
    #[arg(long)]
    reason: String,
    #[command(flatten)]
    change: Change,
}

impl Resume {
    /// Asks for it.
    pub async fn run(self, out: &Out) -> Result<(), Exit> {
        let Self { call, mut stop_id, area, mut robot, mut task_ids, reason, change } = self;
        if !stop_id.is_empty() {
            stop_id = find_stop(&call, &stop_id).await?;
        }
        for id in &mut robot {
            *id = find_robot(&call, id).await?;
        }
        for id in &mut task_ids {
            *id = TaskTarget { call: call.clone(), task_id: std::mem::take(id) }.find().await?;
        }
        let request = v1::ResumeHeldRequest {
            stop_id,
            area_id: area,
            task_ids,
            robot_ids: robot,
            request_id: change.request_id,
            reason,
            validate_only: change.dry_run,
        };
        let answer = call.task().await?.resume_held(unary(request)).await?.into_inner();
        out.one(&answer, "", || resumed(&answer))?;
        if !answer.still_stopped.is_empty() {
            let text = format!("not resumed: {}", answer.still_stopped.join(", "));
            return Err(Exit::new(9, text).or_try("the same again when they are heard: midshift robot ls"));
        }
        out.next("midshift task ls --state held");
        Ok(())
    }
}

/// The whole name of a stop that holds robots, engaged or reset. What holds none stays as it is: the server says whether it knows of it.
async fn find_stop(call: &Call, typed: &str) -> Result<String, Exit> {
    let mut client = call.fleet().await?;
    let listed = async {
        let (controls, _) = robot::controls(&mut client).await?;
        Ok(holding(controls.values(), typed))
    };
    whole_id("stop", typed, listed).await
}

/// Stops that begin with what was typed and hold some of these robots. What a body's own safety system holds is none: it is named whole.
fn holding<'a>(controls: impl IntoIterator<Item = &'a RobotControl>, typed: &str) -> Found {
    let mut stops: BTreeMap<StopId, [usize; 2]> = BTreeMap::new();
    let tokens = controls.into_iter().flat_map(|control| &control.hold_tokens);
    for (stop_id, hold) in tokens.filter_map(|token| Hold::read(token)) {
        if stop_id.as_str().starts_with(typed) {
            stops.entry(stop_id).or_default()[usize::from(hold == Hold::Stop)] += 1;
        }
    }
    let (shown, is_all) = (lookup::SHOWN as usize, stops.len() <= lookup::SHOWN as usize);
    let words = |[waiting, stopped]: [usize; 2]| vec![format!("robots that wait: {waiting}, stopped: {stopped}")];
    Found::new(stops.into_iter().take(shown).map(|(id, robots)| (id.to_string(), words(robots))), is_all)
}

fn resumed(answer: &v1::ResumeHeldResponse) -> String {
    match (answer.robots, answer.pending) {
        (Some(0), _) => "nothing waited for it".to_owned(),
        (Some(1), false) => "1 robot resumed, from when it is heard".to_owned(),
        (Some(robots), false) => format!("{robots} robots resumed, each from when it is heard"),
        (_, true) => "resume asked for; fleet has not looked at it yet".to_owned(),
        (None, false) => "resumed".to_owned(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn held(tokens: &[&str]) -> RobotControl {
        let hold_tokens = tokens.iter().map(|token| (*token).to_owned()).collect();
        RobotControl { hold_tokens, ..RobotControl::default() }
    }

    #[test]
    fn robots_that_waited_are_not_told_as_if_all_of_them_were_heard() {
        let told = |robots| resumed(&v1::ResumeHeldResponse { robots: Some(robots), ..Default::default() });
        assert_eq!(told(0), "nothing waited for it");
        assert_eq!(told(1), "1 robot resumed, from when it is heard");
        assert_eq!(told(28), "28 robots resumed, each from when it is heard");
    }

    #[test]
    fn a_stop_is_meant_by_what_it_alone_begins_with_of_those_that_hold_robots() {
        let controls = [held(&["resume:STOP-aa1", "stop:STOP-b"]), held(&["resume:STOP-aa1", "resume:STOP-aa2"])];
        let meant = |typed: &str| holding(&controls, typed).single("stop", typed);
        assert_eq!(meant("STOP-aa1").expect("itself").as_deref(), Some("STOP-aa1"));
        assert_eq!(meant("STOP-b").expect("it is engaged").as_deref(), Some("STOP-b"));
        assert_eq!(meant("STOP-").expect_err("several").code(), 2);
        let said = meant("STOP-a").expect_err("either").to_string();
        let rows = "\n  STOP-aa1  robots that wait: 2, stopped: 0\n  STOP-aa2  robots that wait: 1, stopped: 0\n";
        assert!(said.contains(rows), "{said}");
        assert_eq!(meant("STOP-c").expect("nothing"), None, "the server says whether it knows it");
    }

    #[test]
    fn what_a_bodys_own_safety_system_holds_is_never_meant_by_a_beginning() {
        let controls = [held(&["resume:body:r10"])];
        assert_eq!(holding(&controls, "body:r1").single("stop", "body:r1").expect("nothing"), None);
    }

    #[test]
    fn of_many_stops_the_first_are_shown_and_that_there_are_more() {
        let tokens: Vec<String> = (10..=10 + lookup::SHOWN).map(|n| format!("resume:STOP-{n}")).collect();
        let controls = [held(&tokens.iter().map(String::as_str).collect::<Vec<_>>())];
        let found = holding(&controls, "STOP-");
        assert_eq!((found.candidates.len(), found.is_all), (lookup::SHOWN as usize, false));
    }
}
