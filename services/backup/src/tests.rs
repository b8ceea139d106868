//! A backup is whole, says when it is not, and what is made of it is a store of its own.

mod postgres;

use super::{Access, AccessOutcome, Identity, Places, back_up, restore, verify};
use midshift_bundle::digest::Digest;
use midshift_bundle::folder::Folder;
use midshift_bundle::keys::SecretKey;
use midshift_bundle::repository::{FileTarget, PEOPLE_LIFE_MS, Profile, sign_targets};
use midshift_core::identity::{
    Act as By, Digest as KeyDigest, Revocation, RobotIdentity, TokenId, TokenRecord, revocations,
};
use midshift_core::ids::{RobotId, SiteId};
use midshift_core::item::{Expect, Item, RowChange, Write};
use midshift_core::rows::{Index, Key, Seq, Table, Writer};
use midshift_core::time::Utc;
use midshift_identity::RevocationList;
use midshift_ota::content::{Completeness, Content, DiskContent, FileRef, Room};
use midshift_ota::folder::{Owner, mark};
use midshift_ota::repository::{Act, OnlineKeys, Repository, raise_floor};
use midshift_ota::{OtaService, Parts};
use midshift_process::clock;
use midshift_store::{FRAME_BYTES_DEFAULT, Frame, FrameLog, SqliteFrames, SqliteStore, Store, load};
use std::fs;
use std::os::unix::fs::PermissionsExt;
use std::path::Path;
use std::sync::Arc;
use tempfile::TempDir;

pub const NOW: Utc = Utc(1_780_000_000_000);

/// A server's data directory, in use.
struct Used {
    dir: TempDir,
    store: SqliteStore,
    frames: SqliteFrames,
}

pub fn site() -> SiteId {
    SiteId::parse("north").expect("a site")
}

async fn open(data: &Path) -> (SqliteStore, SqliteFrames) {
    let clock = clock::clock(1000);
    let store = SqliteStore::open(data, site(), clock.clone()).await.expect("a store");
    let frames = SqliteFrames::open(data, site(), clock, FRAME_BYTES_DEFAULT).await.expect("a log");
    (store, frames)
}

impl Used {
    async fn new() -> Self {
        let dir = tempfile::tempdir().expect("a folder");
        let (store, frames) = open(&dir.path().join("data")).await;
        let used = Self { dir, store, frames };
        used.write_row("a").await;
        let frame = Frame {
            robot_id: midshift_core::ids::RobotId::parse("r-1").expect("a robot"),
            ring: Arc::from("ring"),
            first_seq: 1,
            last_seq: 1,
            bytes: Arc::from(&b"sample"[..]),
        };
        used.frames.append(vec![frame]).await.expect("kept");
        used
    }
    async fn write_row(&self, id: &str) {
        let key = Key::new(Table::Attempt, id);
        let write = Write::Put { body: Arc::from("{}"), index: Index::default() };
        let change = RowChange { key, expect: Expect::Absent, write, kind: "attempt.put" };
        let item = Item { rows: vec![change], ..Item::new(Writer::Fleet, "fleet") };
        self.store.commit(vec![item]).await.remove(0).expect("applied");
    }
    fn places(&self) -> Places {
        Places { data: self.dir.path().join("data"), ota_keys: None, store: None }
    }
    async fn backed_up(&self) -> std::path::PathBuf {
        let to = self.dir.path().join("backup");
        back_up(&self.places(), &to, NOW).await.expect("a backup");
        let mode = std::fs::metadata(&to).expect("it is there").permissions().mode();
        assert_eq!(mode & 0o777, 0o700, "its rows prove robots' successions");
        to
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn what_is_restored_is_the_moment_of_the_copy_in_a_store_of_its_own() {
    let used = Used::new().await;
    let backup = used.backed_up().await;
    used.write_row("later").await;
    let summary = verify(&backup).await.expect("it is good");
    assert_eq!((summary.site_id.as_str(), summary.begun), ("north", NOW));
    let names: Vec<&str> = summary.parts.iter().map(|(name, ..)| name.as_str()).collect();
    assert_eq!(names, ["control", "telemetry"]);
    let to = Places { data: used.dir.path().join("restored"), ota_keys: None, store: None };
    restore(&backup, &to, &Access::default(), NOW).await.expect("restored");
    let (store, frames) = open(&to.data).await;
    assert_ne!(store.id(), used.store.id(), "nobody may go on from a number of the other");
    let rows = store.snapshot(&[Table::Attempt]).await.expect("rows");
    assert_eq!((rows.rows.len(), rows.seq), (1, Seq(used.store.wake().borrow().0 - 1)));
    assert_eq!(frames.marks().await.expect("marks").len(), 1);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn every_change_of_a_backup_is_found_and_nothing_is_restored_of_it() {
    let used = Used::new().await;
    let backup = used.backed_up().await;
    let file = backup.join("control").join("control.db");
    let whole = fs::read(&file).expect("the file");
    let mut other = whole.clone();
    let middle = other.len() / 2;
    other[middle] ^= 1;
    let stray = backup.join("control").join("stray");
    let to = Places { data: used.dir.path().join("restored"), ota_keys: None, store: None };
    type Spoil<'a> = &'a dyn Fn();
    let spoils: [(&str, Spoil); 3] = [
        ("is not what was copied", &|| fs::write(&file, &other).expect("written")),
        ("is not listed", &|| {
            fs::write(&file, &whole).expect("written");
            fs::write(&stray, b"x").expect("written");
        }),
        ("is missing", &|| {
            fs::remove_file(&stray).expect("gone");
            fs::remove_file(&file).expect("gone");
        }),
    ];
    for (told, spoil) in spoils {
        spoil();
        let error = verify(&backup).await.expect_err("it is not good").to_string();
        assert!(error.contains(told), "{error}");
        assert!(restore(&backup, &to, &Access::default(), NOW).await.is_err());
        assert!(!to.data.exists());
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn nothing_is_written_over() {
    let used = Used::new().await;
    let backup = used.backed_up().await;
    let again = back_up(&used.places(), &backup, NOW).await.expect_err("it is there");
    assert!(again.to_string().contains("is there already"), "{again}");
    assert!(restore(&backup, &used.places(), &Access::default(), NOW).await.is_err());
    verify(&backup).await.expect("as it was");
    let nowhere = Places { data: used.dir.path().join("nowhere"), ota_keys: None, store: None };
    let to = used.dir.path().join("of-nothing");
    let error = back_up(&nowhere, &to, NOW).await.expect_err("there is nothing");
    assert!(error.to_string().contains("no server ever served"), "{error}");
    assert!(!to.exists());
}

async fn repository(data: &Path, keys: &Path) -> (Arc<DiskContent>, Repository) {
    let ota = data.join("ota");
    let content = Arc::new(DiskContent::open(&ota.join("content"), Room::with_quota(1 << 30)).expect("a store"));
    let keys = OnlineKeys::read(keys).expect("keys");
    let repository = Repository::open(&ota.join("metadata"), keys, content.clone()).await.expect("a repository");
    (content, repository)
}

/// Publishes one file in the data directory `data` with keys in `dir`. What is signed has at least this version. Where the keys are.
pub async fn release(dir: &Path, data: &Path, version: u64) -> std::path::PathBuf {
    let (keys, people) = (dir.join("keys"), dir.join("repository"));
    Folder::create(&people, &keys, Profile::Solo, NOW).expect("keys and a root");
    let root = Folder::open(&people).expect("it").document("1.root.json").expect("readable").expect("a root");
    let documents = data.join("ota").join("metadata");
    fs::create_dir_all(&documents).expect("a folder");
    raise_floor(&documents, version).expect("written");
    let (content, repository) = repository(data, &keys).await;
    let bytes = b"a file of a release".to_vec();
    let file = FileRef { digest: Digest::of_content(&bytes), length: bytes.len() as u64 };
    let target = FileTarget { name: "walk".to_owned(), digest: file.digest, length: file.length };
    content.append(file, 0, bytes.into()).await.expect("room");
    assert_eq!(content.settle(file).await.expect("asked"), Completeness::Whole);
    let key = SecretKey::read(&keys.join("targets-1.pem")).expect("a key");
    let targets = sign_targets(None, &[target], &[], NOW.plus_ms(PEOPLE_LIFE_MS), &[&key]).expect("signed");
    let act = Act { by: "release".into(), at: NOW };
    repository.publish(vec![root], targets, 0, act).await.expect("published");
    keys
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_restored_repository_signs_above_what_robots_saw_by_the_clock_and_by_the_copy() {
    for (version, least) in [(1, 1_780_000_000), (1_000_000_000_000, 1_000_001_000_000)] {
        let used = Used::new().await;
        let keys = release(used.dir.path(), &used.places().data, version).await;
        let from = Places { ota_keys: Some(keys), ..used.places() };
        let backup = used.dir.path().join("backup");
        back_up(&from, &backup, NOW).await.expect("a backup");
        let at = |name| used.dir.path().join(name);
        let to = Places { data: at("restored"), ota_keys: Some(at("restored-keys")), store: None };
        restore(&backup, &to, &Access::default(), NOW).await.expect("restored");
        let (content, repository) = repository(&to.data, &at("restored-keys")).await;
        let copied = repository.newest().expect("what was published").stamp;
        assert_eq!((copied.version, copied.snapshot_version), (version, version));
        repository.freshen(NOW).await.expect("signed");
        let newest = repository.newest().expect("it goes on");
        assert_eq!((newest.stamp.version, newest.stamp.snapshot_version), (least, least));
        let digest = newest.files["walk"].digest;
        assert!(content.length(digest).await.expect("asked").is_some(), "its file came too");
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn restored_releases_belong_to_the_restored_store_and_those_of_the_lost_one_do_not() {
    let used = Used::new().await;
    let keys = release(used.dir.path(), &used.places().data, 1).await;
    let folder = used.places().data.join("ota");
    mark(&folder, used.store.id()).expect("written");
    let backup = used.backed_up().await;
    let to = Places { data: used.dir.path().join("restored"), ota_keys: None, store: None };
    restore(&backup, &to, &Access::default(), NOW).await.expect("restored");
    let (store, _frames) = open(&to.data).await;
    let owned = |folder: &Path| Parts {
        folder: folder.to_owned(),
        keys: keys.clone(),
        room: Room::with_quota(1 << 30),
        clock: clock::clock(1000),
        owner: Owner::Shared { store_id: store.id().clone(), known_bundles: 1 },
    };
    OtaService::open(owned(&to.data.join("ota"))).await.expect("its own");
    let error = OtaService::open(owned(&folder)).await.err().expect("the lost server's").to_string();
    assert!(error.contains(&format!("belongs to store {}", used.store.id())), "{error}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn keys_come_whole_or_not_at_all() {
    let used = Used::new().await;
    let keys = release(used.dir.path(), &used.places().data, 1).await;
    let backup = used.dir.path().join("backup");
    back_up(&Places { ota_keys: Some(keys), ..used.places() }, &backup, NOW).await.expect("a backup");
    let at = |name| used.dir.path().join(name);
    fs::create_dir(at("there")).expect("an empty folder");
    for (data, keys) in [("there", "new-keys"), ("new", "there")] {
        let to = Places { data: at(data), ota_keys: Some(at(keys)), store: None };
        let error = restore(&backup, &to, &Access::default(), NOW).await.expect_err("it is there").to_string();
        assert!(error.contains("is there already"), "{error}");
        assert!(!at("new").exists() && !at("new-keys").exists());
    }
    let inside = Places { data: at("one"), ota_keys: Some(at("one").join("keys")), store: None };
    restore(&backup, &inside, &Access::default(), NOW).await.expect("both in one folder");
    OnlineKeys::read(&at("one").join("keys")).expect("all of them");
    let left = fs::read_dir(used.dir.path()).expect("a folder").map(|entry| entry.expect("an entry").file_name());
    assert!(left.into_iter().all(|name| !name.to_string_lossy().starts_with(".midshift-")), "nothing half is left");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn with_a_clock_before_the_backup_or_keys_that_it_has_not_nothing_is_restored() {
    let used = Used::new().await;
    let backup = used.backed_up().await;
    let to = Places { data: used.dir.path().join("restored"), ota_keys: None, store: None };
    let error = restore(&backup, &to, &Access::default(), Utc(NOW.0 - 1)).await.expect_err("the clock").to_string();
    assert!(error.contains("clock is before the moment of the backup"), "{error}");
    let with_keys = Places { ota_keys: Some(used.dir.path().join("keys")), ..to.clone() };
    let error = restore(&backup, &with_keys, &Access::default(), NOW).await.expect_err("it has none").to_string();
    assert!(error.contains("no online keys"), "{error}");
    assert!(!to.data.exists());
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_backup_has_the_files_of_a_stop_service_that_runs_and_none_of_one_that_lost_its_latch() {
    let used = Used::new().await;
    let folder = used.places().data.join("stop");
    let parts = midshift_stop::Parts { folder: folder.clone(), site: None, clock: clock::clock(1000) };
    let _service = midshift_stop::StopService::open(parts, Default::default()).expect("opened");
    fs::write(folder.join(midshift_core::stop::LOG), b"what it said").expect("written");
    fs::write(folder.join("roster.snapshot.new"), b"half").expect("written");
    let backup = used.backed_up().await;
    let summary = verify(&backup).await.expect("it is good");
    assert!(summary.has("stop"), "{summary:?}");
    let to = Places { data: used.dir.path().join("restored"), ota_keys: None, store: None };
    restore(&backup, &to, &Access::default(), NOW).await.expect("restored");
    let restored = to.data.join("stop");
    assert!(!restored.join(midshift_core::stop::LOG).exists(), "a log is nothing to bring back");
    assert_eq!(fs::metadata(&restored).expect("a folder").permissions().mode() & 0o777, 0o700);
    for name in ["latch", "key.pem"] {
        assert_eq!(fs::read(restored.join(name)).expect("it is there"), fs::read(folder.join(name)).expect("as here"));
        assert_eq!(fs::metadata(restored.join(name)).expect("a file").permissions().mode() & 0o777, 0o600);
    }
    assert!(!restored.join("roster.snapshot.new").exists(), "what is being written is in no backup");

    fs::write(backup.join("stop/latch"), b"nothing").expect("written");
    let error = verify(&backup).await.expect_err("it is broken").to_string();
    assert!(error.contains("stop/latch is not what was copied") && error.contains("no whole value"), "{error}");
    fs::remove_file(folder.join("latch")).expect("removed");
    let error = back_up(&used.places(), &used.dir.path().join("second"), NOW).await.expect_err("nobody knows");
    assert!(format!("{error:#}").contains("has lost a file: start `midshift-stop` once"), "{error:#}");
}

/// A token and a robot that are known at the backup.
fn known() -> (TokenRecord, RobotIdentity) {
    let token = TokenRecord {
        token_id: TokenId::new("t1").expect("an id"),
        name: "anna".to_owned(),
        person: None,
        digest: KeyDigest([7; 32]),
        grants: vec!["operator".to_owned().into()],
        created_unix_ms: NOW.0,
        created_by: "bert".to_owned(),
        expires_unix_ms: NOW.0 + 1_000_000,
        revoked: None,
        rotation: None,
    };
    let robot = RobotIdentity::new(RobotId::parse("r7").expect("an id"));
    (token, RobotIdentity { key: Some(KeyDigest([1; 32])), enrolled_unix_ms: Some(NOW.0), ..robot })
}

/// Both of them, as identity writes them.
pub fn somebody_known() -> Item {
    let ((token, robot), mut item) = (known(), Item::new(Writer::Identity, "test"));
    item.create(&token, "token.created").create(&robot, "robot.enrolled");
    item
}

/// A list by which both of them were taken back after the backup.
pub fn list_of_both(folder: &Path) -> Access {
    let (token, mut robot) = known();
    robot.revoke("anna", NOW);
    let token = TokenRecord { revoked: Some(By::new("bert", NOW.0)), ..token };
    let lines = revocations([&token], [&robot]);
    let text: String =
        lines.iter().map(|line: &Revocation| serde_json::to_string(line).expect("a line") + "\n").collect();
    let path = folder.join("list");
    fs::write(&path, text).expect("written");
    Access { revocations: Some(path), identity: None }
}

/// Whether the token, and the robot's key, let somebody in.
pub async fn let_in(store: &dyn Store) -> (bool, bool) {
    let (token, _) = load::<TokenRecord>(store, "t1").await.expect("rows").expect("the token");
    let (robot, _) = load::<RobotIdentity>(store, "r7").await.expect("rows").expect("the robot");
    let is_denied = robot.denied.iter().any(|deny| deny.key == KeyDigest([1; 32]));
    assert_ne!(robot.key.is_some(), is_denied);
    (token.stands(NOW), robot.key.is_some())
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn whoever_was_revoked_since_the_backup_is_let_in_again_by_nothing_but_a_persons_word() {
    let used = Used::new().await;
    used.store.commit(vec![somebody_known()]).await.remove(0).expect("applied");
    let identity = used.places().data.join(midshift_identity::FOLDER);
    fs::create_dir_all(&identity).expect("a folder");
    fs::write(identity.join("authority.pem"), "PRIVATE KEY-----\n-----END CERTIFICATE-----\n").expect("written");
    fs::write(identity.join(RevocationList::FILE), "").expect("written");
    let backup = used.backed_up().await;
    assert!(!backup.join("identity").join(RevocationList::FILE).exists(), "a list as old as the rows is worth nothing");
    let to = |name: &str| Places { data: used.dir.path().join(name), ota_keys: None, store: None };
    let error = restore(&backup, &to("asked"), &Access::default(), NOW).await.expect_err("a person must say");
    let error = format!("{error:#}");
    assert!(["--revocations FILE", "re-issue", "as-backed-up"].iter().all(|word| error.contains(word)), "{error}");
    assert!(!to("asked").data.exists());

    let list = list_of_both(used.dir.path());
    let (_, settled) = restore(&backup, &to("merged"), &list, NOW).await.expect("restored");
    assert_eq!(settled, AccessOutcome { tokens: 1, keys: 1, secret: None, is_orphaned: true });
    assert_eq!(let_in(&open(&to("merged").data).await.0).await, (false, false));
    let goes_on = RevocationList::read(&to("merged").data.join("identity").join(RevocationList::FILE)).expect("a list");
    assert_eq!(goes_on.len(), 2, "for a later restore");

    let both = Access { identity: Some(Identity::AsBackedUp), ..list };
    let error = restore(&backup, &to("both"), &both, NOW).await.expect_err("either").to_string();
    assert!(error.contains("takes nothing back"), "{error}");
    let said = |identity| Access { revocations: None, identity: Some(identity) };
    let (_, settled) = restore(&backup, &to("same"), &said(Identity::AsBackedUp), NOW).await.expect("restored");
    assert_eq!((settled, let_in(&open(&to("same").data).await.0).await), (AccessOutcome::default(), (true, true)));
    let (_, settled) = restore(&backup, &to("issued"), &said(Identity::ReIssue), NOW).await.expect("restored");
    assert_eq!((settled.tokens, settled.keys, settled.is_orphaned), (1, 0, false));
    assert_eq!(let_in(&open(&to("issued").data).await.0).await, (false, true));
    assert!(settled.secret.is_some_and(|secret| secret.starts_with("mst.")));
}
