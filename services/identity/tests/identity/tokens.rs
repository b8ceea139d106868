//! Tokens of people and programs.

use crate::world::{World, code};
use midshift_core::identity::{Caller, Digest, Secret};
use midshift_core::reason::{Code, Refusal};
use midshift_identity::IdentityService;
use midshift_proto::access::local;
use midshift_proto::identity::v1::identity_service_server::IdentityService as _;
use midshift_proto::identity::v1::{CreateTokenRequest, ListTokensRequest, RevokeTokenRequest, Token};
use midshift_proto::refusal_of;
use sha2::Digest as _;
use tonic::Status;

const DAY_S: u64 = 24 * 3_600;

pub async fn create(
    identity: &IdentityService,
    name: &str,
    grants: &[&str],
    valid_seconds: u64,
) -> Result<(Token, String), Status> {
    let grants = grants.iter().map(|grant| (*grant).to_owned()).collect();
    let request = CreateTokenRequest { name: name.to_owned(), grants, valid_seconds, ..Default::default() };
    let made = identity.create_token(local(request)).await?.into_inner();
    Ok((made.token.expect("a token"), made.secret))
}

pub async fn revoke(identity: &IdentityService, token_id: &str) -> Result<(), Status> {
    identity.revoke_token(local(RevokeTokenRequest { token_id: token_id.to_owned() })).await.map(drop)
}

pub async fn list(identity: &IdentityService) -> Vec<Token> {
    identity.list_tokens(local(ListTokensRequest::default())).await.expect("a list").into_inner().tokens
}

/// Who shows this, as a port of this process answers.
pub fn holder(world: &World, identity: &IdentityService, shown: &str) -> Result<Caller, Refusal> {
    let secret = Secret::read(Secret::TOKEN, shown).expect("a token");
    let digest = Digest(sha2::Sha256::digest(secret.bytes()).into());
    identity.directory().borrow().holder(secret.id(), &digest, world.clock.now().wall)
}

#[tokio::test]
async fn a_new_site_has_one_token_that_may_do_everything_and_hands_it_out_once() {
    let world = World::new();
    let identity = world.open().await.expect("opened");
    let first = identity.first_token().await.expect("asked").expect("the first");
    assert_eq!(identity.first_token().await.expect("asked"), None);
    assert_eq!(holder(&world, &identity, &first).expect("known").to_string(), "admin");
    let again = world.open().await.expect("opened again");
    assert_eq!(again.first_token().await.expect("asked"), None, "also after a start");
    let spare = again.spare_token().await.expect("another one");
    assert_eq!(holder(&world, &again, &spare).expect("known").to_string(), "admin-2", "a name of its own");
    assert!(holder(&world, &again, &first).is_ok());
}

#[tokio::test]
async fn a_token_is_good_as_soon_as_it_was_handed_out_and_worth_nothing_as_soon_as_it_was_revoked() {
    let world = World::new();
    let identity = world.open().await.expect("opened");
    let (token, secret) = create(&identity, "anna", &["operator@packing"], DAY_S).await.expect("made");
    let anna = holder(&world, &identity, &secret).expect("known");
    assert_eq!((anna.to_string().as_str(), anna.grants()[0].to_string().as_str()), ("anna", "operator@packing"));
    revoke(&identity, &token.token_id).await.expect("revoked");
    assert_eq!(holder(&world, &identity, &secret).expect_err("revoked").reason.code, Code::TokenUnknown);
    revoke(&identity, &token.token_id).await.expect("again: the same answer");
    let unknown = revoke(&identity, "nosuch").await.expect_err("unknown");
    assert_eq!(code(&unknown), Some(Code::TokenNotFound));
}

#[tokio::test]
async fn lists_show_tokens_newest_first_and_nothing_of_their_secrets() {
    let world = World::new();
    let identity = world.open().await.expect("opened");
    let mut secrets = Vec::new();
    for name in ["anna", "bert"] {
        secrets.push(create(&identity, name, &["viewer"], DAY_S).await.expect("made").1);
        world.pass_ms(1_000);
    }
    let listed = list(&identity).await;
    assert_eq!(listed.iter().map(|token| token.name.as_str()).collect::<Vec<_>>(), ["bert", "anna"]);
    let told = format!("{listed:?}");
    let secret = |text: &String| text.rsplit('.').next().unwrap_or_default().to_owned();
    assert!(secrets.iter().map(secret).all(|secret| !told.contains(&secret)));
}

#[tokio::test]
async fn every_broken_rule_of_a_token_is_told_at_once_and_none_is_made() {
    let world = World::new();
    let identity = world.open().await.expect("opened");
    let refused = create(&identity, "Anna Of Packing", &["root", "viewer@"], 60).await.expect_err("refused");
    let fields: Vec<String> = refusal_of(&refused).violations.into_iter().map(|v| v.field).collect();
    assert_eq!(fields, ["name", "grants[0]", "grants[1]", "valid_seconds"]);
    assert!(create(&identity, "anonymous", &["viewer"], DAY_S).await.is_err(), "it stands for nobody");
    for own in ["task", "fleet", "ota", "stop", "identity", "telemetry", "midshift"] {
        assert!(create(&identity, own, &["viewer"], DAY_S).await.is_err(), "{own} acts for itself in the audit");
    }
    let refused = create(&identity, "anna", &["viewer", "auditor@packing", "admin@hall"], DAY_S).await;
    let violations = refusal_of(&refused.expect_err("they are of the site")).violations;
    assert_eq!(violations.iter().map(|v| v.field.as_str()).collect::<Vec<_>>(), ["grants[1]", "grants[2]"]);
    assert_eq!(violations[1].description, "admin@hall permits no more than viewer does: admin is of the whole site");
    assert!(create(&identity, "anna", &[], DAY_S).await.is_err());
    assert!(list(&identity).await.is_empty());
}

#[tokio::test]
async fn the_last_token_that_may_administer_the_site_stays() {
    let world = World::new();
    let identity = world.open().await.expect("opened");
    let (first, _) = create(&identity, "anna", &["admin"], DAY_S).await.expect("made");
    create(&identity, "bert", &["operator"], DAY_S).await.expect("made");
    let refused = revoke(&identity, &first.token_id).await.expect_err("the last one");
    assert_eq!(code(&refused), Some(Code::LastAdmin));
    let last = world.audited().await.pop().expect("a row");
    assert_eq!((last.action.as_str(), last.outcome.as_str()), ("token.revoke", "LAST_ADMIN"));
    assert!(last.is_about(&first.token_id));
    create(&identity, "carla", &["admin"], DAY_S).await.expect("made");
    revoke(&identity, &first.token_id).await.expect("there is another one");
}
