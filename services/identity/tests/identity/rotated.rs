//! Names of tokens, and tokens that take the place of others of their name.

use crate::tokens::{create, holder, list, revoke};
use crate::world::{World, asked_by, code};
use midshift_core::identity::{Caller, Digest, Principal, TokenId, TokenRecord};
use midshift_core::item::Item;
use midshift_core::reason::Code;
use midshift_core::rows::Writer;
use midshift_identity::IdentityService;
use midshift_proto::access::local;
use midshift_proto::identity::v1::identity_service_server::IdentityService as _;
use midshift_proto::identity::v1::{
    CreateTokenRequest, RevokeTokenRequest, RotateTokenRequest, RotateTokenResponse, WhoAmIRequest,
};
use tonic::Status;

const DAY_S: u64 = 24 * 3_600;

fn turn(name: &str) -> RotateTokenRequest {
    RotateTokenRequest { name: name.to_owned(), ..Default::default() }
}

async fn rotate(identity: &IdentityService, request: RotateTokenRequest) -> Result<RotateTokenResponse, Status> {
    Ok(identity.rotate_token(local(request)).await?.into_inner())
}

#[tokio::test]
async fn a_name_is_one_token_s_while_it_stands_and_free_when_it_was_revoked_or_is_over() {
    let world = World::new();
    let identity = world.open().await.expect("opened");
    let (first, _) = create(&identity, "anna", &["viewer"], DAY_S).await.expect("made");
    let refused = create(&identity, "anna", &["viewer"], DAY_S).await.expect_err("she has one");
    assert_eq!((refused.code(), code(&refused)), (tonic::Code::AlreadyExists, Some(Code::TokenNameTaken)));
    create(&identity, "bert", &["viewer"], DAY_S).await.expect("another name");
    revoke(&identity, &first.token_id).await.expect("revoked");
    create(&identity, "anna", &["viewer"], DAY_S).await.expect("the name is free");
    world.pass_ms(DAY_S * 1_000);
    create(&identity, "anna", &["viewer"], DAY_S).await.expect("the other one is over");
    assert_eq!(list(&identity).await.iter().filter(|token| token.name == "anna").count(), 3);
}

#[tokio::test]
async fn a_rotated_token_has_the_rights_and_the_person_of_the_old_one_which_ends_at_once() {
    let world = World::new();
    let identity = world.open().await.expect("opened");
    let asked = CreateTokenRequest {
        name: "laptop".to_owned(),
        grants: vec!["operator@packing".to_owned()],
        valid_seconds: 3 * DAY_S,
        person: "anna".to_owned(),
    };
    let old = identity.create_token(local(asked)).await.expect("made").into_inner();
    world.pass_ms(DAY_S * 1_000);
    let new = rotate(&identity, turn("laptop")).await.expect("rotated");
    let (was, token) = (old.token.expect("a token"), new.token.expect("a token"));
    assert_eq!((&token.name, &token.grants, &token.person), (&was.name, &was.grants, &was.person));
    assert_eq!((&token.rotated_from, token.token_id == was.token_id), (&was.token_id, false));
    let seconds = |time: &Option<prost_types::Timestamp>| time.as_ref().map_or(0, |time| time.seconds);
    assert_eq!(seconds(&token.expire_time) - seconds(&token.create_time), 3 * DAY_S as i64, "as long as the old one");
    assert_eq!(holder(&world, &identity, &old.secret).expect_err("ended").reason.code, Code::TokenUnknown);
    let caller = holder(&world, &identity, &new.secret).expect("known");
    assert_eq!((caller.to_string(), caller.person()), ("laptop".to_owned(), "anna".to_owned()));
    let who = identity.who_am_i(asked_by(caller, WhoAmIRequest {})).await.expect("known").into_inner();
    assert_eq!((who.token_id, who.person), (token.token_id, "anna".to_owned()));
}

#[tokio::test]
async fn with_an_overlap_both_are_good_until_it_is_over_and_the_old_one_may_be_revoked_before() {
    let world = World::new();
    let identity = world.open().await.expect("opened");
    let (_, old) = create(&identity, "line", &["dispatcher"], DAY_S).await.expect("made");
    let new = rotate(&identity, RotateTokenRequest { overlap_seconds: 60, ..turn("line") }).await.expect("rotated");
    let good = |secret: &str| holder(&world, &identity, secret).is_ok_and(|caller| !caller.is_expired());
    assert!(good(&old) && good(&new.secret));
    let refused = create(&identity, "line", &["viewer"], DAY_S).await.expect_err("two of them stand");
    assert_eq!(code(&refused), Some(Code::TokenNameTaken));
    world.pass_ms(60_000);
    assert!(!good(&old) && good(&new.secret));

    let newest = rotate(&identity, RotateTokenRequest { overlap_seconds: 60, ..turn("line") }).await.expect("rotated");
    revoke(&identity, &new.token.expect("a token").token_id).await.expect("revoked");
    assert!(!good(&new.secret) && good(&newest.secret), "nobody waits for the end of the overlap");
}

#[tokio::test]
async fn a_rotation_that_is_asked_for_again_is_one_rotation_and_shows_its_secret_once() {
    let world = World::new();
    let identity = world.open().await.expect("opened");
    create(&identity, "line", &["dispatcher"], DAY_S).await.expect("made");
    let request = RotateTokenRequest { request_id: "req-1".to_owned(), ..turn("line") };
    let first = rotate(&identity, request.clone()).await.expect("rotated");
    let again = rotate(&identity, request.clone()).await.expect("the same request");
    assert_eq!((first.token, again.secret.as_str()), (again.token, ""));
    assert!(!first.secret.is_empty() && holder(&world, &identity, &first.secret).is_ok());
    assert_eq!(list(&identity).await.len(), 2);
    let other = RotateTokenRequest { overlap_seconds: 1, ..request };
    assert_eq!(code(&rotate(&identity, other).await.expect_err("something else")), Some(Code::RequestIdReused));
    let rotated: Vec<_> = world.audited().await.into_iter().filter(|row| row.action == "token.rotate").collect();
    assert_eq!((rotated.len(), rotated[0].request_id.as_str(), rotated[0].about.len()), (1, "req-1", 2));
    assert!(!format!("{rotated:?}").contains(first.secret.rsplit('.').next().expect("a secret")));
}

#[tokio::test]
async fn what_is_not_there_or_not_one_is_not_rotated_and_what_an_old_store_has_twice_goes_on() {
    let world = World::new();
    let identity = world.open().await.expect("opened");
    let code_of = async |name: &str| code(&rotate(&identity, turn(name)).await.expect_err("refused"));
    assert_eq!(code_of("anna").await, Some(Code::TokenNotFound));
    for id in ["t1", "t2"] {
        let record = TokenRecord {
            token_id: TokenId::new(id).expect("an id"),
            name: "anna".to_owned(),
            person: None,
            digest: Digest([1; 32]),
            grants: vec!["viewer".to_owned().into()],
            created_unix_ms: 0,
            created_by: "bert".to_owned(),
            expires_unix_ms: i64::MAX,
            revoked: None,
            rotation: None,
        };
        let mut item = Item::new(Writer::Identity, "bert");
        item.create(&record, "token.created");
        assert!(world.store.commit(vec![item]).await.remove(0).is_ok());
    }
    assert_eq!(code_of("anna").await, Some(Code::TokenNameTaken));
    assert_eq!(list(&identity).await.len(), 2, "both go on");
    revoke(&identity, "t1").await.expect("revoked");
    rotate(&identity, turn("anna")).await.expect("one is left");
}

#[tokio::test]
async fn what_the_holder_of_a_token_decided_has_the_token_s_id_in_the_audit() {
    let world = World::new();
    let identity = world.open().await.expect("opened");
    let (token, secret) = create(&identity, "anna", &["admin"], DAY_S).await.expect("made");
    let anna = holder(&world, &identity, &secret).expect("known");
    let request = CreateTokenRequest {
        name: "bert".to_owned(),
        grants: vec!["viewer".to_owned()],
        valid_seconds: DAY_S,
        ..Default::default()
    };
    identity.create_token(asked_by(anna.clone(), request)).await.expect("made");
    let row = world.audited().await.pop().expect("a row");
    assert_eq!((row.actor.as_str(), row.token_id, row.action.as_str()), ("anna", token.token_id, "token.create"));
    // The last one that may administer the site stays, and that it was to go stands there too.
    let request = RevokeTokenRequest { token_id: row_id(&anna) };
    assert!(identity.revoke_token(asked_by(anna.clone(), request)).await.is_err());
    let row = world.audited().await.pop().expect("a row");
    assert_eq!((row.outcome.as_str(), row.token_id), ("LAST_ADMIN", row_id(&anna)));
}

fn row_id(caller: &Caller) -> String {
    match caller.principal() {
        Principal::Holder { token, .. } => token.to_string(),
        _ => String::new(),
    }
}

#[tokio::test]
async fn two_processes_that_make_one_name_at_once_have_one_token_of_it() {
    let world = World::new();
    let identity = world.open().await.expect("opened");
    let other = world.open().await.expect("opened again");
    let (one, two) =
        tokio::join!(create(&identity, "anna", &["viewer"], DAY_S), create(&other, "anna", &["viewer"], DAY_S));
    assert_eq!([one.is_ok(), two.is_ok()].iter().filter(|made| **made).count(), 1);
    assert_eq!(list(&identity).await.len(), 1);
}
