//! What was taken back is on a list beside the rows, takes it back in older rows, and a machine that these do not know is adopted.

use crate::tokens::{create, holder, revoke};
use crate::world::{Machine, World, code, enrol, secret};
use midshift_core::identity::{Digest, Revocation, RobotIdentity, Secret, TokenName, TokenRecord};
use midshift_core::item::{Item, Write};
use midshift_core::reason::Code;
use midshift_core::rows::{Record, Row};
use midshift_identity::restored::{TABLES, Tokens, lets_somebody_in, put_right};
use midshift_identity::{IdentityService, RevocationList};
use midshift_proto::identity::v1::identity_service_server::IdentityService as _;
use midshift_proto::identity::v1::{
    AdoptRobotRequest, ListRobotIdentitiesRequest, RevokeRobotRequest, RobotIdentity as Shown,
};
use tonic::{Request, Status};

const DAY_S: u64 = 24 * 3_600;

fn list(world: &World) -> Vec<Revocation> {
    RevocationList::read(&world.folder().join(RevocationList::FILE)).expect("a list")
}

async fn revoke_robot(identity: &IdentityService, robot_id: &str) {
    let request = RevokeRobotRequest { robot_id: robot_id.to_owned(), ..Default::default() };
    identity.revoke_robot(Request::new(request)).await.expect("revoked");
}

async fn enrolled(identity: &IdentityService, robot_id: &str) -> Digest {
    let line = secret(identity, robot_id, false).await.expect("a secret");
    enrol(identity, robot_id, &line, &Machine::new()).await.expect("enrolled");
    key(identity, robot_id).await
}

async fn key(identity: &IdentityService, robot_id: &str) -> Digest {
    let request = ListRobotIdentitiesRequest { robot_id_prefix: robot_id.to_owned(), ..Default::default() };
    let robots = identity.list_robot_identities(Request::new(request)).await.expect("a list").into_inner().robots;
    robots[0].key_sha256.parse().expect("a key")
}

async fn rows(world: &World) -> Vec<Row> {
    world.store.snapshot(&TABLES).await.expect("rows").rows
}

/// What an item makes of a record; none: it leaves it.
fn made<R: Record>(item: &Item, id: &str) -> Option<R> {
    let change = item.rows.iter().find(|change| change.key.table == R::TABLE && &*change.key.id == id)?;
    match &change.write {
        Write::Put { body, .. } => serde_json::from_str(body).ok(),
        Write::Delete | Write::Keep => None,
    }
}

#[tokio::test]
async fn what_is_revoked_or_replaced_is_on_the_list_when_whoever_did_it_is_answered() {
    let world = World::new();
    let identity = world.open().await.expect("opened");
    let (anna, _) = create(&identity, "anna", &["operator"], DAY_S).await.expect("made");
    let (r7, r8) = (enrolled(&identity, "r7").await, enrolled(&identity, "r8").await);
    revoke(&identity, &anna.token_id).await.expect("revoked");
    assert!(matches!(&list(&world)[..], [Revocation::Token { token_id, .. }] if token_id.as_str() == anna.token_id));
    revoke_robot(&identity, "r7").await;
    let line = secret(&identity, "r8", true).await.expect("a secret for another machine");
    assert_eq!(list(&world).len(), 2, "its machine goes on");
    enrol(&identity, "r8", &line, &Machine::new()).await.expect("enrolled");
    let keys = list(&world).into_iter().filter_map(|line| match line {
        Revocation::Key { deny, revoked, .. } => Some((deny.key, revoked.is_some())),
        Revocation::Token { .. } => None,
    });
    assert_eq!(keys.collect::<Vec<_>>(), [(r7, true), (r8, false)]);
}

#[tokio::test]
async fn a_revocation_that_cannot_be_put_on_the_list_holds_and_is_not_acknowledged() {
    let world = World::new();
    let identity = world.open().await.expect("opened");
    let (anna, shown) = create(&identity, "anna", &["operator"], DAY_S).await.expect("made");
    let path = world.folder().join(RevocationList::FILE);
    std::fs::create_dir(&path).expect("something in its place");
    let refused = revoke(&identity, &anna.token_id).await.expect_err("it is not on the list");
    assert_eq!((refused.code(), code(&refused)), (tonic::Code::Unavailable, Some(Code::StoreUnavailable)));
    assert!(holder(&world, &identity, &shown).is_err(), "it is taken back all the same");
    std::fs::remove_dir(&path).expect("gone");
    revoke(&identity, &anna.token_id).await.expect("asked again");
    assert_eq!(list(&world).len(), 1);
}

#[tokio::test]
async fn older_rows_have_taken_back_what_is_on_the_list_and_nothing_else() {
    let world = World::new();
    let identity = world.open().await.expect("opened");
    identity.first_token().await.expect("made");
    let (anna, _) = create(&identity, "anna", &["operator"], DAY_S).await.expect("made");
    let r7 = enrolled(&identity, "r7").await;
    enrolled(&identity, "r8").await;
    secret(&identity, "r9", false).await.expect("a secret that waits");
    let old = rows(&world).await;
    assert!(lets_somebody_in(&old, world.clock.now().wall).expect("rows"));
    revoke(&identity, &anna.token_id).await.expect("revoked");
    revoke_robot(&identity, "r7").await;
    let later = enrolled(&identity, "r5").await;
    revoke_robot(&identity, "r5").await;
    let restored = put_right(&old, &list(&world), Tokens::Stay, world.clock.now().wall).expect("rows");
    assert_eq!((restored.tokens, restored.keys, restored.secret), (1, 2, None));
    assert!(restored.is_administered);
    let token: TokenRecord = made(&restored.item, &anna.token_id).expect("changed");
    assert!(token.is_revoked(world.clock.now().wall));
    let robot = |id: &str| made::<RobotIdentity>(&restored.item, id);
    let revoked = robot("r7").expect("changed");
    assert!(revoked.key.is_none() && revoked.knows(&r7) && revoked.revoked.is_some());
    assert!(robot("r5").expect("made").knows(&later), "its key was taken out after it came");
    assert!(robot("r9").expect("changed").enrolment.is_none(), "the secret may have been used since");
    assert_eq!((robot("r8"), restored.item.rows.len()), (None, 5), "with the name that anna leaves");
}

#[tokio::test]
async fn with_new_tokens_only_all_old_ones_end_and_robots_stay() {
    let world = World::new();
    let identity = world.open().await.expect("opened");
    identity.first_token().await.expect("made");
    let (anna, _) = create(&identity, "anna", &["operator"], DAY_S).await.expect("made");
    enrolled(&identity, "r7").await;
    let (old, now) = (rows(&world).await, world.clock.now().wall);
    let restored = put_right(&old, &[], Tokens::Reissue, now).expect("rows");
    assert_eq!((restored.tokens, restored.keys, made::<RobotIdentity>(&restored.item, "r7")), (2, 0, None));
    assert!(made::<TokenRecord>(&restored.item, &anna.token_id).expect("changed").is_revoked(now));
    let secret = Secret::read(Secret::TOKEN, &restored.secret.expect("a token")).expect("a token");
    let new: TokenRecord = made(&restored.item, secret.id().as_str()).expect("made");
    assert!(new.name == "admin" && new.stands(now) && restored.is_administered);
    let name: TokenName = made(&restored.item, "admin").expect("taken");
    assert_eq!(&name.token_id, secret.id());
}

async fn adopt(identity: &IdentityService, robot_id: &str, key: Digest, replace: bool) -> Result<Shown, Status> {
    let request = AdoptRobotRequest { robot_id: robot_id.to_owned(), key_sha256: key.to_string(), replace };
    Ok(identity.adopt_robot(Request::new(request)).await?.into_inner().robot.expect("a robot"))
}

#[tokio::test]
async fn a_machine_that_is_not_known_is_adopted_once_and_stands_in_the_audit() {
    let world = World::new();
    let identity = world.open().await.expect("opened");
    let r8 = enrolled(&identity, "r8").await;
    let unknown = Digest([9; 32]);
    let shown = adopt(&identity, "r7", unknown, false).await.expect("adopted");
    assert_eq!(shown.key_sha256, unknown.to_string());
    assert_eq!(adopt(&identity, "r7", unknown, false).await.expect("again"), shown);
    let rows = world.audited().await.into_iter().filter(|row| row.action == "robot.adopt").collect::<Vec<_>>();
    assert!(rows.len() == 1 && rows[0].is_about("robot:r7") && rows[0].with.contains_key("key"), "{rows:?}");
    for (robot_id, key, why) in [("r6", r8, Code::KeyDenied), ("r8", Digest([8; 32]), Code::RobotEnrolled)] {
        let refused = adopt(&identity, robot_id, key, false).await.expect_err("refused");
        assert_eq!((refused.code(), code(&refused)), (tonic::Code::FailedPrecondition, Some(why)), "{robot_id}");
    }
    adopt(&identity, "r8", Digest([8; 32]), true).await.expect("instead of its machine");
    assert!(identity.directory().borrow().denies(&r8));
    assert!(matches!(&list(&world)[..], [Revocation::Key { deny, .. }] if deny.key == r8));
}
