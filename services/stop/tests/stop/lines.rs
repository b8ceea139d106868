//! Robots' lines: what they carry, when they end, and that none of them holds up another.

use crate::harness::{Folder, Robot, Server, WITHIN, code, eventually, fleet, id_of, scope, within};
use midshift_core::ids::StopId;
use midshift_core::site::grid;
use midshift_proto::convert::stop::ToStop;
use midshift_proto::refusal_of;
use midshift_proto::status::Answer;
use midshift_proto::stop::v1;
use midshift_proto::stop::v1::scope::Scope as W;
use midshift_proto::stop::v1::stop_link_service_client::StopLinkServiceClient;
use midshift_stop::{Error, Parts, StopService};
use prost::Message;
use std::sync::Arc;
use std::time::Duration;
use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;
use tokio_util::sync::CancellationToken;
use tonic::client::Grpc;
use tonic::codegen::http::uri::PathAndQuery;
use tonic::{Code, Request};
use tonic_health::pb::HealthCheckRequest;
use tonic_health::pb::health_client::HealthClient;
use tonic_prost::ProstCodec;

#[tokio::test]
async fn a_check_in_is_answered_with_its_number_and_what_was_told() {
    let folder = Folder::new();
    let server = Server::start(&folder.path()).await;
    let mut robot = Robot::dial(&server, "r1", vec![]).await.synced().await;
    for _ in 0..3 {
        let said = robot.obeying(true);
        robot.check_in(said).await;
        // `Robot::read` holds each answer against the newest change it was told.
        server.engage(fleet()).await.unwrap();
    }
    robot.until(|robot| robot.effective().len() == 3).await;
    let heard = server.status().await.robots[0].heard_unix_ms;
    assert!(heard > 1_780_000_000_000, "{heard}");
}

/// Reads a line to its end: why it ended.
async fn ended(line: &mut Robot) -> String {
    loop {
        match line.read().await {
            Ok(true) => {}
            Ok(false) => return String::new(),
            Err(status) => return refusal_of(&status).reason,
        }
    }
}

async fn standing(server: &Server) -> u32 {
    server.status().await.stops[0].counts.unwrap().standstill_confirmed
}

#[tokio::test]
async fn a_newer_line_of_a_robot_takes_the_place_of_the_older_one() {
    let folder = Folder::new();
    let server = Server::start(&folder.path()).await;
    let mut older = Robot::dial(&server, "r1", vec![]).await.synced().await;
    let said = older.obeying(true);
    older.check_in(said).await;
    let mut newer = Robot::dial(&server, "r1", vec![]).await.synced().await;
    assert_eq!(ended(&mut older).await, "LINE_REPLACED");
    let said = newer.obeying(true);
    newer.check_in(said).await;
}

#[tokio::test]
async fn a_copied_key_takes_over_no_line_that_is_heard_and_confirms_nothing_in_its_place() {
    let folder = Folder::new();
    let server = Server::start(&folder.path()).await;
    let mut own = Robot::dial(&server, "r1", vec![]).await.synced().await;
    let id = id_of(&server.engage(fleet()).await.unwrap());
    own.until(|robot| robot.knows(&id)).await;
    let said = own.obeying(false);
    own.check_in(said).await;
    for _ in 0..5 {
        let said = own.obeying(false);
        own.check_in(said).await;
        let refused = Robot::start(&server, "r1", "a copy", vec![]).await.err().unwrap();
        let answer = refusal_of(&refused);
        assert_eq!((answer.grpc, answer.reason.as_str()), (Code::Unavailable, "LINE_HELD"));
        let again = answer.retry_after.unwrap();
        assert!(again > Duration::ZERO && again <= Duration::from_secs(3), "{again:?}");
    }
    assert_eq!(standing(&server).await, 0, "it drives, and says so itself");
    let said = own.obeying(true);
    own.check_in(said).await;
    assert_eq!(standing(&server).await, 1);
    let noted = || std::fs::read_to_string(folder.path().join("audit.jsonl")).unwrap().matches("LINE_HELD").count();
    eventually(async || (noted() > 0).then_some(())).await;
    // Until it is not heard any more: a power cut closes no line.
    server.ahead(3_000);
    let mut other = Robot::start(&server, "r1", "a copy", vec![]).await.unwrap().synced().await;
    assert_eq!(ended(&mut own).await, "LINE_REPLACED");
    assert_eq!(standing(&server).await, 0, "what the start before confirmed confirms nothing of this one");
    let said = other.obeying(true);
    other.check_in(said).await;
    assert_eq!(standing(&server).await, 1);
    server.end().await;
    assert_eq!(noted(), 1, "it floods nothing");
}

#[tokio::test]
async fn a_robot_whose_agent_was_killed_is_let_in_when_that_ones_line_has_ended() {
    let folder = Folder::new();
    let server = Server::start(&folder.path()).await;
    let mut killed = Robot::dial(&server, "r1", vec![]).await.synced().await;
    let said = killed.obeying(true);
    killed.check_in(said).await;
    drop(killed);
    let next = eventually(async || Robot::start(&server, "r1", "the next boot", vec![]).await.ok()).await;
    next.synced().await;
}

#[tokio::test]
async fn what_a_robot_brings_by_name_alone_is_shown_and_its_reset_reaches_it() {
    let folder = Folder::new();
    let server = Server::start(&folder.path()).await;
    let [was_reset, unknown] = ["STOP-20260601-AAAAAAAAAA", "STOP-20260601-BBBBBBBBBB"];
    server.reset(was_reset).await;
    let engaged = id_of(&server.engage(fleet()).await.unwrap());
    let more = [was_reset, unknown, engaged.as_str()].map(|id| StopId::parse(id).unwrap()).into();
    let mut robot = Robot::bringing(&server, "r1", more).await.synced().await;
    let is_told = |robot: &Robot, id: &str| robot.latch.reset_of(&StopId::parse(id).unwrap()).is_some();
    robot.until(|robot| is_told(robot, was_reset)).await;
    assert!(!is_told(&robot, unknown) && !is_told(&robot, &engaged));
    assert_eq!(server.status().await.robots[0].foreign_stops, [unknown]);
    assert!(!server.reset(unknown).await.is_unknown, "a robot knows of it");
    robot.until(|robot| is_told(robot, unknown)).await;
}

#[tokio::test]
async fn a_robot_on_an_old_connection_has_its_next_line_before_it_leaves_this_one() {
    let folder = Folder::new();
    let server = Server::start(&folder.path()).await;
    let mut old = Robot::dial(&server, "r1", vec![]).await.synced().await;
    for _ in 0..10 {
        server.age();
        old.until(|robot| robot.is_moved).await;
        // Nothing is missed meanwhile: it is answered, and told of stops.
        let id = id_of(&server.engage(fleet()).await.unwrap());
        old.until(|robot| robot.knows(&id)).await;
        let said = old.obeying(true);
        old.check_in(said).await;
        let mut next = Robot::dial(&server, "r1", vec![]).await.synced().await;
        assert!(next.knows(&id) && !next.is_moved);
        let said = next.obeying(true);
        next.check_in(said).await;
        while let Ok(true) = old.read().await {}
        old = next;
    }
    assert_eq!(server.status().await.robots.len(), 1);
}

#[tokio::test]
async fn a_line_that_does_not_begin_with_attend_or_breaks_its_rules_is_refused() {
    let folder = Folder::new();
    let server = Server::start(&folder.path()).await;
    let robot = Robot::dial(&server, "r1", vec![]).await.synced().await;
    let messages = [
        (&ToStop::CheckIn(robot.obeying(true))).into(),
        v1::AttendRequest { message: None },
        v1::AttendRequest { message: Some(v1::attend_request::Message::Attend(v1::Attend::default())) },
    ];
    for message in messages {
        let (up, sent) = mpsc::channel(1);
        up.send(message).await.unwrap();
        let mut client = StopLinkServiceClient::new(server.channel().await);
        assert_eq!(code(client.attend(ReceiverStream::new(sent)).await), Code::InvalidArgument);
    }
}

/// `AttendRequest` as it is on the wire, with any bytes for a message.
#[derive(Clone, PartialEq, prost::Message)]
struct Said {
    #[prost(bytes = "vec", tag = "1")]
    attend: Vec<u8>,
    #[prost(bytes = "vec", tag = "2")]
    check_in: Vec<u8>,
}

/// The status with which a line ends on which this is said.
async fn status_at_the_end(server: &Server, said: Vec<Said>) -> Answer {
    let mut client = Grpc::new(server.channel().await);
    client.ready().await.unwrap();
    let path = PathAndQuery::from_static("/midshift.stop.v1.StopLinkService/Attend");
    let codec = ProstCodec::<Said, v1::AttendResponse>::default();
    let status = match within(client.streaming(Request::new(tokio_stream::iter(said)), path, codec)).await {
        Err(status) => status,
        Ok(begun) => {
            let mut down = begun.into_inner();
            loop {
                match within(down.message()).await {
                    Ok(message) => assert!(message.is_some(), "the line ended without a reason"),
                    Err(status) => break status,
                }
            }
        }
    };
    refusal_of(&status)
}

#[tokio::test]
async fn a_line_on_which_a_rule_is_broken_or_nothing_can_be_read_ends_with_the_reason() {
    let folder = Folder::new();
    let server = Server::start(&folder.path()).await;
    let attend = v1::Attend { robot_id: "r1".to_owned(), boot_id: "boot".to_owned(), ..v1::Attend::default() };
    let attend = Said { attend: attend.encode_to_vec(), check_in: vec![] };
    let garbage = Said { attend: vec![], check_in: vec![0xff; 8] };
    for said in [vec![garbage.clone()], vec![attend.clone(), garbage]] {
        let answer = status_at_the_end(&server, said).await;
        assert_eq!((answer.grpc, answer.reason.as_str()), (Code::InvalidArgument, "PROTOCOL_ERROR"));
        assert!(answer.message.starts_with("a message cannot be read: "), "{}", answer.message);
    }
    let twice = status_at_the_end(&server, vec![attend.clone(), attend]).await;
    assert_eq!((twice.grpc, twice.violations[0].field.as_str()), (Code::InvalidArgument, "message"));
}

/// Eighty stops of 2 KiB are more than a connection holds for a robot that reads nothing.
#[tokio::test]
async fn a_robot_that_reads_nothing_holds_up_nobody_and_hears_everything_when_it_reads_again() {
    let folder = Folder::new();
    let map = format!("type octile\nheight 24\nwidth 24\nmap\n{}", format!("{}\n", ".".repeat(24)).repeat(24));
    let site = Arc::new(grid::parse_map("hall", &map).unwrap());
    let area = site.areas()[0].area_id.to_string();
    let server = Server::with_site(&folder.path(), Some(site)).await;
    let mut slow = Robot::dial(&server, "slow", vec![]).await;
    let mut quick = Robot::dial(&server, "quick", vec![]).await.synced().await;
    let mut client = server.client().await;
    for n in 0..80 {
        let request = scope(W::AreaId(area.clone()));
        let mut stream = within(client.engage(request)).await.unwrap().into_inner();
        let id = id_of(&within(stream.message()).await.unwrap().unwrap());
        quick.until(|robot| robot.knows(&id)).await;
        let said = quick.obeying(true);
        quick.check_in(said).await;
        if n % 8 == 0 {
            server.reset(&id).await;
            let said = slow.obeying(true);
            slow.say(said).await;
        }
    }
    let last = id_of(&server.engage(fleet()).await.unwrap());
    quick.until(|robot| robot.knows(&last) && robot.effective().len() == 71).await;
    slow.until(|robot| robot.knows(&last)).await;
    let said = slow.obeying(true);
    slow.check_in(said).await;
    assert_eq!(slow.effective(), quick.effective(), "without those that were reset meanwhile");
}

#[tokio::test]
async fn an_end_in_order_asks_robots_to_dial_again_and_is_bounded() {
    let folder = Folder::new();
    let server = Server::start(&folder.path()).await;
    let mut robot = Robot::dial(&server, "r1", vec![]).await.synced().await;
    let mut watch = server.client().await.watch_status(v1::WatchStatusRequest {}).await.unwrap().into_inner();
    let id = id_of(&server.engage(fleet()).await.unwrap());
    server.ask_to_end();
    while robot.read().await.is_ok_and(|goes_on| goes_on) {}
    assert!(robot.is_moved && robot.knows(&id), "what waits for it is said first");
    while within(watch.message()).await.is_ok_and(|message| message.is_some()) {}
    tokio::time::timeout(WITHIN, server.end()).await.expect("it ends");
}

#[tokio::test]
async fn one_process_has_a_folder_at_a_time() {
    let folder = Folder::new();
    let _server = Server::start(&folder.path()).await;
    let clock = midshift_core::time::ScaledClock::new(|| 0, midshift_core::time::Utc(0), 1000);
    let parts = Parts { folder: folder.path(), site: None, clock: Arc::new(clock) };
    let second = StopService::open(parts, CancellationToken::new());
    assert!(matches!(second.err(), Some(Error::Latch(midshift_latch::Error::Held { .. }))));
}

#[tokio::test]
async fn health_and_reflection_speak_of_this_service_and_nothing_else() {
    use tonic_reflection::pb::v1::server_reflection_client::ServerReflectionClient;
    use tonic_reflection::pb::v1::server_reflection_request::MessageRequest;
    use tonic_reflection::pb::v1::server_reflection_response::MessageResponse;
    let folder = Folder::new();
    let server = Server::start(&folder.path()).await;
    for service in ["", "midshift.stop.v1.StopService", "midshift.stop.v1.StopLinkService"] {
        let request = HealthCheckRequest { service: service.to_owned() };
        let answer = HealthClient::new(server.channel().await).check(request).await.unwrap().into_inner();
        assert_eq!(answer.status, 1, "{service}");
    }
    let list = MessageRequest::ListServices(String::new());
    let request =
        tonic_reflection::pb::v1::ServerReflectionRequest { host: String::new(), message_request: Some(list) };
    let stream = tokio_stream::iter([request]);
    let mut client = ServerReflectionClient::new(server.channel().await);
    let mut answers = client.server_reflection_info(stream).await.unwrap().into_inner();
    let answer = answers.message().await.unwrap().unwrap().message_response.unwrap();
    let MessageResponse::ListServicesResponse(list) = answer else { panic!("{answer:?}") };
    let mut names: Vec<String> = list.service.into_iter().map(|service| service.name).collect();
    names.sort_unstable();
    assert_eq!(names, ["grpc.health.v1.Health", "midshift.stop.v1.StopLinkService", "midshift.stop.v1.StopService"]);
}

#[tokio::test]
async fn many_robots_hear_a_stop_and_each_is_counted() {
    let folder = Folder::new();
    let server = Server::start(&folder.path()).await;
    let mut robots = Vec::new();
    for n in 0..100 {
        robots.push(Robot::dial(&server, &format!("r{n}"), vec![]).await.synced().await);
    }
    let id = id_of(&server.engage(fleet()).await.unwrap());
    for robot in &mut robots {
        robot.until(|robot| robot.knows(&id)).await;
        let said = robot.obeying(true);
        robot.check_in(said).await;
    }
    let counted = async || server.status().await.stops[0].counts.unwrap().standstill_confirmed == 100;
    eventually(async || counted().await.then_some(())).await;
}
