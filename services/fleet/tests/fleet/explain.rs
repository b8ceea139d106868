//! Why not: each case has a reason that names what is in the way.

use crate::harness::{World, jam, obstacle};
use midshift_core::fleet::rows::HolderState;
use midshift_core::reason::Code;
use midshift_core::robot::{HardwareStop, Load, Mode};
use midshift_core::site::CORRIDOR;
use midshift_core::task::Phase;
use midshift_core::task::raw::RawRetry;
use midshift_proto::access::local;
use midshift_proto::common::v1::Reason;
use midshift_proto::fleet::v1;
use midshift_proto::fleet::v1::fleet_service_server::FleetService;

/// The verdict's code, and the reason against `r1`.
pub async fn why(w: &World, task_id: &str) -> (String, String) {
    let ask = v1::ExplainTaskRequest { task_id: task_id.to_owned() };
    let told = w.fleet.explain_task(local(ask)).await.expect("an explanation").into_inner();
    let told = told.explanation.expect("an explanation");
    let of_robot = told.candidates.iter().find(|c| c.robot_id == "r1").and_then(|c| c.reason.clone());
    (told.verdict.map(|r| r.code).unwrap_or_default(), of_robot.map(|r| r.code).unwrap_or_default())
}

fn codes(verdict: Code, robot: &str) -> (String, String) {
    (verdict.as_str().to_owned(), robot.to_owned())
}

#[tokio::test(start_paused = true)]
async fn no_robot_is_available() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "park-a").await;
    w.r("r1").cut();
    w.pass(40).await;
    w.submit("T1", "A", "B").await;
    w.pass(2).await;
    assert_eq!(why(&w, "T1").await, codes(Code::WaitingForRobot, "ROBOT_OFFLINE"));
}

#[tokio::test(start_paused = true)]
async fn a_task_that_was_accepted_a_moment_ago_waits_for_the_planner_that_has_not_read_it() {
    let mut w = World::on(CORRIDOR).await;
    let head = *w.store.wake().borrow();
    w.shaky.feed_up_to(Some(head));
    w.submit("T1", "A", "B").await;
    w.pass(1).await;
    let told = of_task(&w, "T1").await;
    assert_eq!(told.code, Code::WaitingInQueue.as_str(), "{told:?}");
    assert_eq!(told.metadata["waits_for"], "the planner: it has not read the task yet");
    w.shaky.feed_up_to(None);
    w.pass(2).await;
    assert_eq!(why(&w, "T1").await, codes(Code::WaitingForRobot, ""));
}

#[tokio::test(start_paused = true)]
async fn no_robot_has_the_capability() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "park-a").await;
    w.submit_with("T1", "A", "B", |raw| raw.capabilities = vec!["weld".to_owned()]).await;
    w.pass(2).await;
    assert_eq!(why(&w, "T1").await, codes(Code::WaitingForRobot, "MISSING_CAPABILITY"));
}

#[tokio::test(start_paused = true)]
async fn the_pinned_robot_is_cordoned() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "park-a").await;
    w.robot("r2", "park-b").await;
    let cordon = v1::CordonRobotRequest { robot_id: "r1".to_owned(), reason: "wheel".to_owned(), ..Default::default() };
    w.pass(1).await;
    w.fleet.cordon_robot(local(cordon)).await.expect("cordoned");
    w.submit_with("T1", "A", "B", |raw| raw.robot_id = "r1".to_owned()).await;
    w.pass(2).await;
    assert_eq!(why(&w, "T1").await, codes(Code::WaitingForRobot, "ROBOT_CORDONED"));
}

#[tokio::test(start_paused = true)]
async fn a_dependency_is_not_met() {
    let mut w = World::on(CORRIDOR).await;
    w.submit_with("T1", "A", "B", |raw| raw.depends_on = vec!["T0".to_owned()]).await;
    w.pass(2).await;
    assert_eq!(why(&w, "T1").await, codes(Code::WaitingForDependency, ""));
}

#[tokio::test(start_paused = true)]
async fn the_robot_carries_something_else() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "park-a").await;
    w.r("r1").load = Some(Load { task_id: None, item: "a box of somebody".to_owned() });
    w.beat("r1");
    w.submit("T1", "A", "B").await;
    w.pass(2).await;
    assert_eq!(why(&w, "T1").await, codes(Code::WaitingForRobot, "ROBOT_LOADED"));
}

#[tokio::test(start_paused = true)]
async fn the_robot_has_too_little_charge_or_a_person_drives_it() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "charge").await;
    w.r("r1").works = false;
    w.r("r1").battery_permille = 150;
    w.beat("r1");
    w.submit("T1", "A", "B").await;
    w.pass(3).await;
    assert_eq!(why(&w, "T1").await, codes(Code::WaitingForRobot, "BATTERY_LOW"));
    assert_eq!(of_robot(&w, "r1").await.code, "WORKS_ON_STEP", "it charges");
}

/// The verdict of a robot.
async fn of_robot(w: &World, robot_id: &str) -> Reason {
    let ask = v1::ExplainRobotRequest { robot_id: robot_id.to_owned() };
    let told = w.fleet.explain_robot(local(ask)).await.expect("an explanation").into_inner();
    told.explanation.expect("an explanation").verdict.expect("a verdict")
}

/// The verdict of a task.
async fn of_task(w: &World, task_id: &str) -> Reason {
    let ask = v1::ExplainTaskRequest { task_id: task_id.to_owned() };
    let told = w.fleet.explain_task(local(ask)).await.expect("an explanation").into_inner();
    told.explanation.expect("an explanation").verdict.expect("a verdict")
}

/// The code of both verdicts, which agree, and what both wait for.
async fn of_both(w: &World, task_id: &str, robot_id: &str) -> (String, String) {
    let (task, robot) = (of_task(w, task_id).await, of_robot(w, robot_id).await);
    let told = |reason: &Reason| (reason.code.clone(), reason.metadata.get("waits_for").cloned().unwrap_or_default());
    assert_eq!(told(&task), told(&robot), "{task:?} {robot:?}");
    told(&task)
}

fn pair(code: &str, waits_for: &str) -> (String, String) {
    (code.to_owned(), waits_for.to_owned())
}

#[tokio::test(start_paused = true)]
async fn a_robot_that_has_said_that_it_works_is_believed_before_its_next_heartbeat() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "park-a").await;
    w.submit("T1", "A", "B").await;
    w.until_phase("T1", Phase::Running).await;
    assert_eq!(of_both(&w, "T1", "r1").await.0, "WORKS_ON_STEP");
}

#[tokio::test(start_paused = true)]
async fn an_attempt_is_told_as_its_robot_answers_works_is_stopped_and_driven_by_hand() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "park-a").await;
    w.r("r1").works = false;
    w.submit("T1", "A", "B").await;
    w.until_phase("T1", Phase::Running).await;
    w.pass(2).await;
    assert_eq!(of_both(&w, "T1", "r1").await.0, "WORKS_ON_STEP");
    w.r("r1").set_hardware_stop(HardwareStop::Manual);
    w.pass(3).await;
    assert_eq!(of_both(&w, "T1", "r1").await.1, "a person at robot r1");
    assert!(of_task(&w, "T1").await.message.contains("own safety system"), "{:?}", of_task(&w, "T1").await);
    w.r("r1").set_hardware_stop(HardwareStop::None);
    w.pass(3).await;
    assert_eq!(of_both(&w, "T1", "r1").await.1, "a person's resume");
    w.resume("r1").await;
    w.r("r1").set_mode(Mode::Manual);
    w.pass(3).await;
    assert_eq!(of_both(&w, "T1", "r1").await, pair("ROBOT_MANUAL", "a person at robot r1"));
    w.r("r1").set_mode(Mode::Automatic);
    w.pass(3).await;
    w.r("r1").cut();
    w.pass(5).await;
    assert_eq!(of_both(&w, "T1", "r1").await, pair("ROBOT_SUSPECT", "robot r1"));
    w.pass(40).await;
    let (code, waits_for) = of_both(&w, "T1", "r1").await;
    assert_eq!((code.as_str(), waits_for.as_str()), ("LEASE_OVER", "robot r1"));
    assert!(of_task(&w, "T1").await.metadata.contains_key("uncertain_since"));
}

#[tokio::test(start_paused = true)]
async fn a_task_that_ended_is_told_with_how_and_when_and_by_whom() {
    let mut w = World::on(CORRIDOR).await;
    w.submit("T1", "A", "B").await;
    w.pass(1).await;
    w.cancel("T1", false).await;
    w.until_phase("T1", Phase::Canceled).await;
    w.pass(2).await;
    let told = of_task(&w, "T1").await;
    assert_eq!((told.code.as_str(), told.metadata["state"].as_str()), ("TASK_ENDED", "CANCELED"));
    assert_eq!(told.metadata["cause"], "CANCELED_BY_PERSON");
    assert!(!told.metadata["end_time"].is_empty() && told.metadata.contains_key("actor"), "{told:?}");
}

#[tokio::test(start_paused = true)]
async fn a_robot_with_a_load_of_nobody_waits_for_a_person() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "park-a").await;
    w.r("r1").load = Some(Load { task_id: None, item: "a box of somebody".to_owned() });
    w.pass(10).await;
    let told = of_robot(&w, "r1").await;
    assert_eq!((told.code.as_str(), told.metadata["waits_for"].as_str()), ("ROBOT_LOADED", "a person at robot r1"));
    assert_eq!(told.metadata["item"], "a box of somebody");
}

#[tokio::test(start_paused = true)]
async fn a_robot_with_an_item_of_a_task_that_needs_a_person_waits_for_that_word() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "park-a").await;
    w.r("r1").fails = Some((2, jam()));
    w.submit("T1", "A", "B").await;
    w.until_phase("T1", Phase::NeedsOperator).await;
    let uncordon = v1::UncordonRobotRequest { robot_id: "r1".to_owned(), ..Default::default() };
    w.fleet.uncordon_robot(local(uncordon)).await.expect("uncordoned");
    w.pass(10).await;
    let told = of_robot(&w, "r1").await;
    let waits_for = told.metadata["waits_for"].as_str();
    assert_eq!(
        (told.code.as_str(), waits_for),
        ("ROBOT_LOADED", "a person: midshift task resolve T1 --as ANSWER --reason TEXT")
    );
}

#[tokio::test(start_paused = true)]
async fn a_robot_that_waits_for_a_place_names_its_holder() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "B").await;
    w.robot("r2", "park-a").await;
    w.r("r1").drives = false;
    w.submit_with("T2", "A", "B", |raw| raw.robot_id = "r2".to_owned()).await;
    w.until("r2 is in A", |s| s.holders("A") == [("r2".to_owned(), HolderState::Inside)]).await;
    w.pass(15).await;
    let (code, waits_for) = of_both(&w, "T2", "r2").await;
    assert_eq!(code, "PLACE_OCCUPIED");
    assert!(waits_for.contains("B") && waits_for.contains("r1"), "{waits_for}");
}

#[tokio::test(start_paused = true)]
async fn a_robot_whose_task_waits_for_its_next_try_is_told_when_that_is() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "park-a").await;
    w.r("r1").fails = Some((2, obstacle()));
    let in_ten_minutes = RawRetry { max_retry_times: 1, interval_ms: Some(600_000), ..RawRetry::default() };
    w.submit_with("T1", "A", "B", |raw| raw.retry = Some(in_ten_minutes.clone())).await;
    let waits = |s: &crate::harness::Seen| s.phase("T1") == Phase::RetryWait && s.is_free("r1");
    let seen = w.until("it carries its item and has nothing to do", waits).await;
    w.pass(2).await;
    let at = seen.task("T1").retry_at.expect("a time").rfc3339();
    let told = of_robot(&w, "r1").await;
    assert_eq!(
        (told.code.as_str(), told.metadata["waits_for"].clone()),
        ("ROBOT_LOADED", format!("the next try at {at}"))
    );
    assert_eq!(told.metadata["task_id"], "T1");
    w.until_phase("T1", Phase::Succeeded).await;
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn a_closed_place_is_the_goal_and_the_task_goes_on_when_it_opens() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r2", "park-a").await;
    w.submit("T1", "A", "B").await;
    w.until("it stands in A", |s| s.holders("A") == [("r2".to_owned(), HolderState::Inside)]).await;
    w.r("r2").cut();
    w.cancel("T1", false).await;
    w.until("nobody knows where it is", |s| s.place("A").quarantine.is_some()).await;
    w.robot("r1", "park-b").await;
    w.submit("T2", "A", "B").await;
    w.pass_while(60, "it is given to nobody", |s| s.phase("T2") == Phase::Queued).await;
    assert_eq!(why(&w, "T2").await, codes(Code::WaitingForRobot, "PLACE_OCCUPIED"));
    w.r("r2").mend();
    w.connect("r2").await;
    w.until_phase("T2", Phase::Succeeded).await;
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn who_has_no_work_but_at_a_closed_place_is_told_by_whom_since_when_and_what_opens_it() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r2", "park-a").await;
    w.submit("T1", "A", "B").await;
    w.until("it stands in A", |s| s.holders("A") == [("r2".to_owned(), HolderState::Inside)]).await;
    w.r("r2").cut();
    w.cancel("T1", false).await;
    let seen = w.until("nobody knows where it is", |s| s.place("A").quarantine.is_some()).await;
    let since = seen.attempt("T1").ended.expect("it was given up").rfc3339();
    w.robot("r1", "park-b").await;
    w.submit("T2", "A", "B").await;
    w.pass(10).await;
    let robot = of_robot(&w, "r1").await;
    assert_eq!((robot.code.as_str(), robot.metadata["robots"].as_str()), ("PLACE_OCCUPIED", "r2"));
    for told in [robot, of_task(&w, "T2").await] {
        let words = ["Place A", "r2", since.as_str(), "`midshift zone clear A --reason TEXT --if-match ETAG`"];
        assert!(words.iter().all(|word| told.message.contains(word)), "{told:?}");
    }
}

#[tokio::test(start_paused = true)]
async fn the_way_through_its_goals_is_longer_than_a_robot_takes() {
    let mut w = World::on(long_site()).await;
    w.robot("r1", "w0").await;
    // 30 times along 100 waypoints and back.
    w.submit_with("T1", "w0", "w99", |raw| {
        let (away, home) = (raw.steps[2].clone(), raw.steps[0].clone());
        raw.steps = (0..30).flat_map(|_| [away.clone(), home.clone()]).collect();
    })
    .await;
    w.submit("T2", "w0", "w99").await;
    w.until_phase("T2", Phase::Succeeded).await;
    assert_eq!(why(&w, "T1").await, codes(Code::WaitingForRobot, "ROUTE_TOO_LONG"));
    w.lawful().await;
}

/// 100 waypoints in a row, with a station at either end.
fn long_site() -> &'static str {
    let kind = |n: u32| if n == 0 || n == 99 { ", kind = \"station\"" } else { "" };
    let waypoints: String =
        (0..100).map(|n| format!("{{ id = \"w{n}\", at = [{}, 0]{} }},\n", n * 1_000, kind(n))).collect();
    let path = (0..100).map(|n| format!("\"w{n}\"")).collect::<Vec<_>>().join(", ");
    let names =
        "site_id = \"long\"\nname = \"A row\"\nmap_id = \"long\"\nmap_version = \"1\"\narea = [{ id = \"hall\" }]";
    let site = format!("{names}\nwaypoint = [\n{waypoints}]\nlane = [{{ path = [{path}], ways = \"two\" }}]\n");
    Box::leak(site.into_boxed_str())
}
