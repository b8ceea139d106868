//! Directive keys from `rekey` to the repository, and that nobody signs on top of an old copy.

use super::*;

struct Place {
    dir: tempfile::TempDir,
    out: Out,
}

impl Place {
    fn new() -> Self {
        let this = Self { dir: tempfile::tempdir().expect("a folder"), out: Out::new(Format::Name) };
        keygen(ProfileArg::Solo, &this.path("keys"), &this.path("repository"), &this.out).expect("made");
        this
    }
    fn path(&self, name: &str) -> PathBuf {
        self.dir.path().join(name)
    }
    fn rekey(&self, by: &str, keys: &[&str], number: u64) -> Result<(), Exit> {
        let keys: Vec<PathBuf> = keys.iter().map(|key| self.path("keys").join(key)).collect();
        let into = self.path(&format!("{number}.directive-keys"));
        rekey(&self.path("keys").join(by), &keys, number, &into, &self.out)
    }
    async fn sign(&self, number: u64, upstream: Option<PathBuf>) -> Result<(), Exit> {
        let verb = Verb::Sign {
            bundle: Some(self.path(&format!("{number}.directive-keys"))),
            pending: false,
            renew: false,
            from: Vec::new(),
            repository: self.path("repository"),
            key: vec![self.path("keys/targets-1.pem")],
            signature: Vec::new(),
            server: None,
            upstream,
        };
        run(verb, &self.out).await
    }
    fn copy(&self, to: &str) -> PathBuf {
        for part in ["metadata", "targets"] {
            std::fs::create_dir_all(self.path(to).join(part)).expect("a folder");
            for entry in std::fs::read_dir(self.path("repository").join(part)).expect("a folder") {
                let entry = entry.expect("an entry");
                std::fs::copy(entry.path(), self.path(to).join(part).join(entry.file_name())).expect("copied");
            }
        }
        self.path(to)
    }
}

#[tokio::test]
async fn a_directive_key_is_drawn_handed_over_and_ended() {
    let place = Place::new();
    place.rekey("directive-1.pem", &["directive-2.pem", "directive-1.pem"], 1).expect("made");
    place.sign(1, None).await.expect("signed");
    assert!(place.rekey("directive-2.pem", &["directive-2.pem"], 1).is_err(), "no file is written over");
    place.rekey("directive-2.pem", &["directive-2.pem"], 2).expect("the key that was drawn is there");
    place.sign(2, None).await.expect("signed");
    let set = Folder::open(&place.path("repository")).expect("there").check().expect("whole").key_set.expect("listed");
    let new = SecretKey::read(&place.path("keys/directive-2.pem")).expect("drawn").public();
    assert_eq!((set.number, set.keys), (2, vec![new]));
    place.rekey("directive-1.pem", &["directive-3.pem"], 3).expect("made");
    assert!(place.sign(3, None).await.is_err(), "its key has ended");
}

#[tokio::test]
async fn nothing_is_signed_on_top_of_a_copy_that_is_behind_or_another_project() {
    let place = Place::new();
    let older = place.copy("older");
    place.rekey("directive-1.pem", &["directive-1.pem"], 1).expect("made");
    place.sign(1, Some(older)).await.expect("it has all that the copy has");
    let newer = place.copy("newer");
    std::fs::remove_file(place.path("repository/metadata/1.targets.json")).expect("an older one");
    let exit = place.sign(1, Some(newer.clone())).await.expect_err("behind");
    assert_eq!(exit.code(), 9);
    place.sign(1, None).await.expect("nobody was asked");
    std::fs::write(newer.join("metadata/1.targets.json"), "{}").expect("another one");
    assert_eq!(place.sign(1, Some(newer)).await.expect_err("another").code(), 9);
}

#[test]
fn what_robots_are_given_has_the_newest_root_and_a_key_whose_orders_they_take() {
    let place = Place::new();
    let (into, repository) = (place.path("trust.json"), place.path("repository"));
    let write = |directive: &[PathBuf]| root::trust(&repository, directive, "demo", &into, &place.out);
    assert!(write(&[]).is_err(), "robots would take orders of nobody");
    let folder = Folder::open(&repository).expect("there");
    folder.draft_root(None, clock::wall()).expect("a draft");
    let key = SecretKey::read(&place.path("keys/root-1.pem")).expect("a key");
    assert_eq!(folder.sign_root(&[&key], &[]).expect("signed"), Signed::Published(2));
    write(&[place.path("keys/directive-1.pem")]).expect("written");
    let trust = midshift_agent::trust_anchors::TrustAnchors::read(&into).expect("a robot reads it");
    let directive = SecretKey::read(&place.path("keys/directive-1.pem")).expect("a key").public();
    assert_eq!(trust.directive_keys.into_values().collect::<Vec<_>>(), [directive]);
    assert!(String::from_utf8_lossy(&trust.root).contains("\"version\":2"), "a newer one than it began with");
}
