//! What goes after its time and what stays, in files of SQLite.

use crate::tokens::{create, holder, list, revoke};
use crate::world::World;
use midshift_core::fleet::rows::{Cordon, RobotControl};
use midshift_core::identity::{Deny, Digest, EnrolmentState, RobotIdentity, ServerCertificate, TokenId};
use midshift_core::ids::RobotId;
use midshift_core::item::Item;
use midshift_core::reason::Code;
use midshift_core::rows::{Record, Table, Writer};
use midshift_core::time::Utc;

const DAY_S: u64 = 24 * 3_600;
const DAY_MS: i64 = 1_000 * DAY_S.cast_signed();

impl World {
    fn pass_days(&self, days: u64) {
        self.pass_ms(days * DAY_S * 1_000);
    }
    async fn prune(&self) -> u64 {
        midshift_identity::prune(&*self.store, &*self.clock).await.expect("prunes")
    }
    async fn create<R: Record>(&self, writer: Writer, row: &R) {
        let mut item = Item::new(writer, "tests");
        item.create(row, "tests.created");
        self.store.commit(vec![item]).await.remove(0).expect("applied");
    }
    async fn ids(&self, table: Table) -> Vec<String> {
        let rows = self.store.snapshot(&[table]).await.expect("a store").rows;
        rows.iter().map(|row| row.key.id.to_string()).collect()
    }
}

#[tokio::test]
async fn a_token_goes_a_month_after_it_is_good_for_nothing_and_no_sooner_for_being_revoked() {
    let world = World::in_files().await;
    let identity = world.open().await.expect("opened");
    identity.first_token().await.expect("asked").expect("the first");
    let (revoked, first) = create(&identity, "wms", &["viewer"], DAY_S).await.expect("made");
    let (_, second) = create(&identity, "erp", &["viewer"], DAY_S).await.expect("made");
    revoke(&identity, &revoked.token_id).await.expect("revoked");
    world.pass_ms(1);
    create(&identity, "anna", &["viewer"], 366 * DAY_S).await.expect("the newest");
    // A day, a month in which it would still have stopped robots, and most of another.
    world.pass_days(60);
    assert_eq!((world.prune().await, list(&identity).await.len()), (0, 4));
    world.pass_days(2);
    assert_eq!(world.prune().await, 3, "two tokens, and the name of the one that had it to its end");
    let names: Vec<String> = list(&identity).await.into_iter().map(|token| token.name).collect();
    assert_eq!(names, ["anna", "admin"]);
    for shown in [first, second] {
        assert_eq!(holder(&world, &identity, &shown).expect_err("gone").reason.code, Code::TokenUnknown);
    }
    create(&identity, "erp", &["viewer"], DAY_S).await.expect("the name is free");
}

#[tokio::test]
async fn the_newest_token_stays_or_a_start_would_hand_out_a_first_one_again() {
    let world = World::in_files().await;
    let identity = world.open().await.expect("opened");
    identity.first_token().await.expect("asked").expect("the first");
    world.pass_ms(1);
    create(&identity, "wms", &["viewer"], DAY_S).await.expect("made");
    world.pass_days(1_000);
    world.prune().await;
    let names: Vec<String> = list(&identity).await.into_iter().map(|token| token.name).collect();
    assert_eq!(names, ["wms"]);
    assert_eq!(identity.first_token().await.expect("asked"), None);
}

#[tokio::test]
async fn a_certificate_of_a_server_goes_a_month_after_its_end_and_what_is_unanswered_stays() {
    let world = World::in_files().await;
    let now = world.clock.now().wall;
    let server = |n: u8, chain: Option<&str>, expires_unix_ms: i64| ServerCertificate {
        key: Digest([n; 32]),
        names: Vec::new(),
        request_pem: String::new(),
        chain_pem: chain.map(str::to_owned),
        expires_unix_ms,
    };
    let old = server(1, Some("chain"), now.0 - 31 * DAY_MS);
    let kept = [server(2, Some("chain"), now.0 - 29 * DAY_MS), server(3, None, 0)];
    for row in kept.iter().chain([&old]) {
        world.create(Writer::Identity, row).await;
    }
    assert_eq!(world.prune().await, 1);
    assert_eq!(world.ids(Table::ServerCertificate).await, kept.map(|row| row.id()));
}

#[tokio::test]
async fn the_identity_of_a_robot_goes_when_it_was_retired_long_ago_and_nobody_is_let_in_or_kept_out_by_it() {
    let world = World::in_files().await;
    let now = world.clock.now().wall;
    let day = |days: i64| now.0 + days * DAY_MS;
    let robot = |id: &str| RobotIdentity::new(RobotId::parse(id).expect("an id"));
    let key = Some(Digest([1; 32]));
    let enrolment = |days| EnrolmentState {
        secret_id: TokenId::new("s1").expect("an id"),
        digest: Digest([2; 32]),
        expires_unix_ms: day(days),
        used_unix_ms: None,
    };
    let deny = |days| vec![Deny { key: Digest([3; 32]), until_unix_ms: day(days) }];
    let cases = [
        (robot("r1"), Some(31)),
        (RobotIdentity { key, expires_unix_ms: Some(day(-1)), ..robot("r2") }, Some(31)),
        (RobotIdentity { denied: deny(-1), enrolment: Some(enrolment(-1)), ..robot("r3") }, Some(31)),
        (RobotIdentity { key, expires_unix_ms: Some(day(1)), ..robot("s1") }, Some(31)),
        (RobotIdentity { denied: deny(1), ..robot("s2") }, Some(31)),
        (RobotIdentity { enrolment: Some(enrolment(1)), ..robot("s3") }, Some(31)),
        (robot("s4"), Some(29)),
        (robot("s5"), None),
    ];
    for (row, retired_days) in cases {
        let mut control = RobotControl::new(row.robot_id.clone());
        control.retired = retired_days.map(|days| Cordon {
            reason: "sold".to_owned(),
            actor: "anna".to_owned(),
            since: Utc(now.0 - days * DAY_MS),
        });
        world.create(Writer::Fleet, &control).await;
        world.create(Writer::Identity, &row).await;
    }
    assert_eq!(world.prune().await, 3);
    assert_eq!(world.ids(Table::RobotIdentity).await, ["s1", "s2", "s3", "s4", "s5"]);
    assert_eq!(world.ids(Table::RobotControl).await.len(), 8, "that they were retired stays");
}
