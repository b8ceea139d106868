//! Who engages, who resets, and who comes as a robot.

use crate::harness::{Folder, Robot, Server, asked_as, eventually, fleet, id_of, scope};
use midshift_core::ids::RobotId;
use midshift_core::site::{DEMO, text};
use midshift_proto::convert::stop::ToStop;
use midshift_proto::refusal_of;
use midshift_proto::stop::v1;
use midshift_proto::stop::v1::scope::Scope as W;
use midshift_proto::stop::v1::stop_link_service_client::StopLinkServiceClient;
use std::fs;
use std::sync::Arc;
use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;
use tonic::{Code, Status};

async fn server(folder: &Folder) -> Server {
    Server::with_site(&folder.path(), Some(Arc::new(text::parse(DEMO).unwrap()))).await
}

async fn engage(server: &Server, who: &str, request: v1::EngageRequest) -> v1::EngageResponse {
    let mut stream = server.client().await.engage(asked_as(who, request)).await.unwrap().into_inner();
    stream.message().await.unwrap().unwrap()
}

async fn reset(server: &Server, who: &str, stop_id: &str) -> Result<v1::ResetResponse, Status> {
    let request =
        v1::ResetRequest { stop_id: stop_id.to_owned(), reason: "looked, is clear".to_owned(), site_id: String::new() };
    Ok(server.client().await.reset(asked_as(who, request)).await?.into_inner())
}

fn area(id: &str) -> v1::EngageRequest {
    scope(W::AreaId(id.to_owned()))
}

#[tokio::test]
async fn anyone_engages_any_part_under_its_own_name_and_a_reset_needs_its_role_where_the_stop_is() {
    let folder = Folder::new();
    let server = server(&folder).await;
    let cases = [
        (area("hall"), true),
        (area("quality"), false),
        (scope(W::Zone("A01".to_owned())), true),
        (scope(W::Zone("door".to_owned())), false),
        (scope(W::RobotId("r1".to_owned())), false),
        (fleet(), false),
    ];
    for (request, may) in cases {
        let engaged = engage(&server, "panel stop-only@packing", request).await;
        assert_eq!(engaged.stop.as_ref().unwrap().actor, "panel");
        let stop_id = id_of(&engaged);
        for who in ["bea operator admin", "bea stop-resetter@packing"] {
            let refused = reset(&server, who, &stop_id).await.unwrap_err();
            assert_eq!(
                (refused.code(), refusal_of(&refused).reason.as_str()),
                (Code::PermissionDenied, "NOT_PERMITTED")
            );
        }
        let own = reset(&server, "bea stop-resetter@hall", &stop_id).await;
        assert_eq!(own.is_ok(), may, "{own:?}");
        if !may {
            assert!(server.engaged().await.contains(&stop_id), "what was refused reset nothing");
            reset(&server, "bea stop-resetter", &stop_id).await.unwrap();
        }
        assert!(!server.engaged().await.contains(&stop_id));
    }
    let unknown = reset(&server, "bea stop-resetter@hall", "STOP-never").await.unwrap_err();
    assert_eq!(unknown.code(), Code::PermissionDenied, "a stop that nobody knows may be anywhere");
    let audit = || fs::read_to_string(folder.path().join("audit.jsonl")).unwrap();
    // Refusals wait for the disk, whoever was refused does not.
    let denied = || audit().lines().filter(|line| line.contains("\"DENIED\"") && line.contains("\"bea\"")).count();
    eventually(async || (denied() == 17).then_some(())).await;
    let audit = audit();
    let actors = |action: &str, actor: &str| {
        audit.lines().filter(|line| line.contains(action) && line.contains(&format!("\"{actor}\""))).count()
    };
    assert_eq!([actors("\"ENGAGED\"", "panel"), actors("\"RESET\"", "bea")], [6, 6], "{audit}");
}

#[tokio::test]
async fn a_certificate_of_another_robot_begins_no_line_and_ends_none() {
    let folder = Folder::new();
    let server = server(&folder).await;
    let mut robot = Robot::dial(&server, "r1", vec![]).await.synced().await;
    let attend = async |who: &str| {
        let (up, sent) = mpsc::channel(4);
        let (robot_id, boot_id) = (RobotId::parse("r1").unwrap(), "boot".to_owned());
        up.send((&ToStop::Attend { robot_id, boot_id, stops: vec![], more: vec![] }).into()).await.unwrap();
        let mut client = StopLinkServiceClient::new(server.channel().await);
        client.attend(asked_as(who, ReceiverStream::new(sent))).await.map(drop)
    };
    for who in ["robot:r2", "anna admin stop-resetter"] {
        let refused = attend(who).await.unwrap_err();
        assert_eq!((refused.code(), refusal_of(&refused).reason.as_str()), (Code::PermissionDenied, "NOT_THIS_ROBOT"));
    }
    let said = robot.obeying(true);
    robot.check_in(said).await;
    attend("robot:r1").await.unwrap();
}
