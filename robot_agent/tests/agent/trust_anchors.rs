//! The file of what a robot believes from the day it was set up.

use crate::release::{Releases, SIGNED};
use midshift_agent::trust_anchors::{Error, TrustAnchors};
use midshift_bundle::keys::SecretKey;
use midshift_bundle::trust::{Reading, Source, Trusted};
use midshift_core::ids::SiteId;
use serde_json::{Value, json};
use std::fs;
use std::io;
use std::sync::Arc;

#[derive(Debug)]
pub struct Metadata(pub Releases);

#[async_trait::async_trait]
impl Source for Metadata {
    async fn fetch(&self, name: &str) -> io::Result<Option<Vec<u8>>> {
        midshift_agent::update::io::Remote::metadata(&self.0, name).await
    }
}

fn trust(releases: &Releases) -> TrustAnchors {
    let config = releases.config();
    let site = SiteId::parse("hall-1").expect("a name");
    TrustAnchors { root: config.root, directive_keys: config.directive_keys, site }
}

#[tokio::test]
async fn what_was_written_is_what_a_robot_believes() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("trust.json");
    let releases = Releases::new();
    releases.release("1.0.0");
    trust(&releases).write(&path).expect("writes");
    let read = TrustAnchors::read(&path).expect("reads");
    assert_eq!((&read.directive_keys, read.site.as_str()), (&releases.config().directive_keys, "hall-1"));
    let config = read.config();
    assert!(config.clock_synced && !config.is_launched && !config.allows_safety_related);
    let source = Arc::new(Metadata(releases));
    let clock = Reading { utc: SIGNED, is_synced: config.clock_synced };
    let refreshed = Trusted::new(&config.root).expect("a root").refresh(source, clock).await.expect("is believed");
    assert_eq!(refreshed.targets.len(), 3);
    read.write(&path).expect("writes");
    assert_eq!(TrustAnchors::read(&path).expect("reads"), read, "writing it again changes nothing");
}

#[test]
fn a_file_is_refused_with_all_that_is_wrong_with_it() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("trust.json");
    trust(&Releases::new()).write(&path).expect("writes");
    let good: Value = serde_json::from_slice(&fs::read(&path).expect("reads")).expect("is JSON");
    let fields = |change: &dyn Fn(&mut Value)| {
        let mut page = good.clone();
        change(&mut page);
        fs::write(&path, page.to_string()).expect("writes");
        match TrustAnchors::read(&path) {
            Err(Error::Refused { refusal, .. }) => refusal.violations.into_iter().map(|v| v.field).collect::<Vec<_>>(),
            other => panic!("{other:?}"),
        }
    };
    let key = |seed: u8| SecretKey::of_seed([seed; 32]).public().tuf();
    assert_eq!(fields(&|page| page["site"] = json!(1)), ["trust"]);
    assert_eq!(fields(&|page| page["root"]["signed"]["version"] = json!(2)), ["root"]);
    assert_eq!(fields(&|page| page["directive_keys"] = json!([])), ["directive_keys"]);
    assert_eq!(fields(&|page| page["directive_keys"] = (1..=9).map(key).collect()), ["directive_keys"]);
    assert_eq!(fields(&|page| page["directive_keys"] = json!([key(1), key(1)])), ["directive_keys[1]"]);
    assert_eq!(fields(&|page| page["directive_keys"][0]["note"] = json!("mine")), ["directive_keys[0]"]);
    assert_eq!(fields(&|page| page["directive_keys"][0]["keyval"]["public"] = json!("é")), ["directive_keys[0]"]);
    let all = fields(&|page| *page = json!({"root": {}, "directive_keys": [7, key(1)], "site": "Hall 1"}));
    assert_eq!(all, ["root", "directive_keys[0]", "site"]);
}

#[test]
fn a_file_that_no_robot_would_take_is_not_written() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("trust.json");
    let good = trust(&Releases::new());
    let nobody = TrustAnchors { directive_keys: Default::default(), ..good.clone() };
    assert!(matches!(nobody.write(&path), Err(Error::Refused { .. })));
    let rootless = TrustAnchors { root: b"{}".to_vec(), ..good };
    assert!(matches!(rootless.write(&path), Err(Error::Refused { .. })));
    assert!(!path.exists());
    assert!(matches!(TrustAnchors::read(&path), Err(Error::Io { .. })));
}
