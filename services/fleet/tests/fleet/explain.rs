//! Why not: each case has a reason that names what is in the way.

use crate::harness::World;
use midshift_core::fleet::rows::HolderState;
use midshift_core::reason::Code;
use midshift_core::robot::Load;
use midshift_core::site::CORRIDOR;
use midshift_core::task::Phase;
use midshift_proto::fleet::v1;
use midshift_proto::fleet::v1::fleet_service_server::FleetService;
use tonic::Request;

/// The verdict's code, and the reason against `r1`.
pub async fn why(w: &World, task_id: &str) -> (String, String) {
    let ask = v1::ExplainTaskRequest { task_id: task_id.to_owned() };
    let told = w.fleet.explain_task(Request::new(ask)).await.expect("an explanation").into_inner();
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
    w.fleet.cordon_robot(Request::new(cordon)).await.expect("cordoned");
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
    let ask = v1::ExplainRobotRequest { robot_id: "r1".to_owned() };
    let told = w.fleet.explain_robot(Request::new(ask)).await.expect("an explanation").into_inner();
    let verdict = told.explanation.expect("an explanation").verdict.expect("a verdict").code;
    assert_eq!(verdict, "ROBOT_BUSY", "it charges");
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
    assert_eq!(why(&w, "T2").await, codes(Code::WaitingForRobot, "PLACE_BLOCKED"));
    w.r("r2").mend();
    w.connect("r2").await;
    w.until_phase("T2", Phase::Succeeded).await;
    w.lawful().await;
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
