//! A thief of the server's keys drives the versions of the repository up, so that nothing newer could follow; its
//! owners rotate the root.

use crate::release::{Bundle, Releases};
use crate::rig::Rig;
use crate::updates::{committed, connected, refused, stage, state, switch, why};
use midshift_core::reason::Code;
use midshift_core::update::UpdateState;

/// Versions of a thief: nobody signs as often.
const FORWARD: u64 = u64::MAX / 2;

/// A release whose program has this index.
fn indexed(releases: &Releases, version: &str, index: u64) -> Bundle {
    releases.release_as(version, |manifest| manifest.components[0].rollback_index = index)
}

/// What the robot has believed, as it is written down.
fn believed(rig: &Rig) -> serde_json::Value {
    let trusted = rig.store.memory().expect("loaded").ledger.trusted.clone().expect("believes something");
    serde_json::to_value(&*trusted).expect("is JSON")
}

/// Whether the newest versions of metadata are the thief's: timestamp and snapshot.
fn is_forward(rig: &Rig) -> bool {
    believed(rig).to_string().contains(&FORWARD.to_string())
}

/// Tells the robot to stage a bundle; why it did not even look at it, if so.
fn told(rig: &mut Rig, releases: &Releases, bundle: &Bundle, generation: u64) -> Option<Code> {
    let before = refused(rig).len();
    stage(rig, releases, bundle, generation);
    refused(rig).get(before).copied()
}

#[test]
fn after_a_fast_forward_and_a_root_rotation_the_next_good_bundle_is_taken_and_never_an_older_one() {
    let (rig, releases) = connected();
    let [first, second, third] = [("1.0.0", 1), ("1.1.0", 2), ("1.2.0", 3)].map(|(v, n)| indexed(&releases, v, n));
    let rig = committed(rig, &releases, &second, 1);
    let mut rig = committed(rig, &releases, &third, 2);
    let runs = switch(&rig);
    let honest = releases.documents();

    // The thief's versions are signed with good keys: they are believed, and buy him no bundle.
    releases.forward(FORWARD);
    assert_eq!(told(&mut rig, &releases, &first, 3), None, "a release lists it");
    assert_eq!((state(&rig), why(&rig)), (Some(UpdateState::Refused), Some(Code::BundleUnfit)), "below the floor");
    assert!(is_forward(&rig), "the attack has come to the robot");
    let stranger = Releases::new().release("6.6.6");
    assert_eq!(told(&mut rig, &releases, &stranger, 4), Some(Code::DirectiveRefused), "no release lists it");

    // With the old keys there is no way on, not even for the owners.
    let fourth = indexed(&releases, "1.3.0", 4);
    assert_eq!(told(&mut rig, &releases, &fourth, 5), Some(Code::MetadataRefused));
    let mut rig = rig.restart();
    rig.connect();
    assert_eq!(told(&mut rig, &releases, &fourth, 6), Some(Code::MetadataRefused), "nor after a restart");
    assert_eq!(switch(&rig), runs, "what runs goes on running");

    // The owners give the server new keys. The next good bundle is taken.
    releases.rotate((13, 14));
    releases.pass(1_000);
    let mut rig = committed(rig, &releases, &fourth, 7);
    assert!(!is_forward(&rig), "the new keys count from their own beginning");
    assert_eq!(switch(&rig).previous.as_deref(), Some(runs.current.as_str()));

    // Nothing older comes back: not by the owners' own directive, and no documents of before, honest or the thief's.
    let runs = switch(&rig);
    for (generation, bundle) in [(8, &first), (9, &second)] {
        assert_eq!(told(&mut rig, &releases, bundle, generation), None);
        assert_eq!((state(&rig), why(&rig)), (Some(UpdateState::Refused), Some(Code::BundleUnfit)));
    }
    let newest = releases.documents();
    releases.replay(&honest);
    assert_eq!(told(&mut rig, &releases, &third, 10), Some(Code::MetadataRefused), "signed with the keys of before");
    assert_eq!(switch(&rig), runs);
    releases.replay(&newest);
    let rig = committed(rig, &releases, &indexed(&releases, "1.4.0", 5), 11);
    assert_eq!(switch(&rig).previous.as_deref(), Some(runs.current.as_str()));
}

#[test]
fn a_new_root_is_written_down_though_nothing_is_signed_with_its_keys_yet() {
    let (mut rig, releases) = connected();
    let [first, second] = ["1.0.0", "1.1.0"].map(|version| releases.release(version));
    assert_eq!(told(&mut rig, &releases, &first, 1), None);
    let floor = believed(&rig)["time_floor"].clone();
    releases.rotate((13, 14));
    assert_eq!(told(&mut rig, &releases, &second, 2), Some(Code::MetadataRefused));
    let after = believed(&rig);
    assert_eq!((&after["versions"]["root"], &after["time_floor"]), (&serde_json::json!(2), &floor));
    let mut rig = rig.restart();
    rig.connect();
    assert_eq!(told(&mut rig, &releases, &second, 3), Some(Code::MetadataRefused), "keys of before are ended");
    releases.pass(1_000);
    assert_eq!((told(&mut rig, &releases, &second, 4), state(&rig)), (None, Some(UpdateState::Staged)));
}
