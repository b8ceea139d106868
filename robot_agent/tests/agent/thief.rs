//! Stolen keys as docs/runbooks/keys.md tells of them: what a thief of each can do to a robot, what he cannot, and that
//! he is nobody once they were changed.

use crate::release::{Bundle, Releases, SIGNED};
use crate::rig::Rig;
use crate::updates::{Order, committed, refused, state, switch, want};
use midshift_bundle::digest::Digest;
use midshift_bundle::keys::SecretKey;
use midshift_bundle::repository::{FileTarget, PEOPLE_LIFE_MS, sign_targets};
use midshift_core::reason::Code;
use midshift_core::update::{Goal, UpdateState};

const DAY_MS: u64 = 24 * 3_600_000;
/// Seeds of the server's keys at first: of snapshot and timestamp, and of directives.
const ONLINE: (u8, u8) = (3, 4);
const DIRECTIVE: u8 = 7;
/// Those that the server has after the change.
const NEW_ONLINE: (u8, u8) = (13, 14);
const NEW_DIRECTIVE: u8 = 8;
/// A key of the thief's own.
const OWN: u8 = 66;

/// A robot that runs a bundle of the repository.
fn robot(releases: &Releases, bundle: &Bundle) -> Rig {
    let mut rig = Rig::updatable(releases);
    rig.connect();
    committed(rig, releases, bundle, 1)
}

/// Orders the robot to stage `bundle` by the key of seed `by`; why it did not even look at it, if so.
fn ordered(rig: &mut Rig, releases: &Releases, by: u8, bundle: &Bundle, generation: u64) -> Option<Code> {
    let before = refused(rig).len();
    let mut order = Order::new(releases.directive_by(by, bundle, generation));
    order.generation = generation * 1_000;
    want(rig, order.to(Goal::Stage));
    refused(rig).get(before).copied()
}

/// The targets document of this number.
fn targets(releases: &Releases, number: u64) -> Vec<u8> {
    releases.documents()[&format!("{number}.targets.json")].clone()
}

#[test]
fn a_thief_of_all_keys_of_a_server_holds_a_robot_back_until_they_are_changed_and_is_nobody_afterwards() {
    let releases = Releases::new();
    let first = releases.release("1.1.0");
    let (before, old) = (releases.documents(), targets(&releases, 2));
    let second = releases.release("1.2.0");
    let newest = targets(&releases, 3);
    let (mut met, mut honest) = (robot(&releases, &second), robot(&releases, &second));
    let runs = switch(&met);

    // An old repository, an old list under a new number, and a list of his own.
    releases.replay(&before);
    assert_eq!(ordered(&mut met, &releases, DIRECTIVE, &first, 2), Some(Code::MetadataRefused));
    releases.present(ONLINE, (2, &old), 50);
    assert_eq!(ordered(&mut met, &releases, DIRECTIVE, &first, 3), Some(Code::MetadataRefused));
    let evil = FileTarget { name: "walk-6.6.6.manifest".to_owned(), digest: Digest::of_content(b"evil"), length: 4 };
    let by = SecretKey::of_seed([ONLINE.0; 32]);
    let forged = sign_targets(Some(&newest), &[evil], &[], SIGNED.plus_ms(PEOPLE_LIFE_MS), &[&by]).expect("signed");
    releases.present(ONLINE, (4, &forged), 51);
    assert_eq!(ordered(&mut met, &releases, DIRECTIVE, &first, 4), Some(Code::MetadataRefused));

    // What he can: hold it at a release that was signed, and order it to any bundle that this lists.
    let third = releases.release("1.3.0");
    let shown = releases.documents();
    releases.present(ONLINE, (3, &newest), 52);
    assert_eq!(ordered(&mut met, &releases, DIRECTIVE, &third, 5), Some(Code::DirectiveRefused), "it is kept from it");
    assert_eq!(ordered(&mut met, &releases, DIRECTIVE, &first, 6), None);
    assert_eq!(state(&met), Some(UpdateState::Staged));
    let stranger = Releases::new().release("6.6.6");
    assert_eq!(
        ordered(&mut met, &releases, DIRECTIVE, &stranger, 7),
        Some(Code::DirectiveRefused),
        "nobody released it"
    );
    releases.replay(&shown);
    assert_eq!(
        ordered(&mut met, &releases, DIRECTIVE, &third, 8),
        Some(Code::MetadataRefused),
        "52 is above the server's"
    );

    // The ceremony. The robot that he kept away comes back by itself, and the other one notices nothing.
    releases.rotate(NEW_ONLINE);
    releases.list_keys(1, &[NEW_DIRECTIVE], DIRECTIVE);
    let changed = releases.documents();
    for (rig, generation) in [(&mut met, 9), (&mut honest, 2)] {
        assert_eq!(ordered(rig, &releases, NEW_DIRECTIVE, &third, generation), None);
        assert_eq!((state(rig), switch(rig)), (Some(UpdateState::Staged), runs.clone()), "what runs is untouched");
    }
    assert_eq!((refused(&honest), honest.exit), (vec![], None));

    // The thief afterwards: his documents, his orders, and a set of his own that nobody lists.
    releases.present(ONLINE, (3, &newest), 1_000);
    assert_eq!(ordered(&mut met, &releases, NEW_DIRECTIVE, &second, 10), Some(Code::MetadataRefused));
    releases.replay(&changed);
    releases.hold_keys(2, &[OWN], DIRECTIVE);
    for (by, generation) in [(DIRECTIVE, 11), (OWN, 12)] {
        assert_eq!(ordered(&mut met, &releases, by, &first, generation), Some(Code::BadSignature), "key {by}");
    }
    assert_eq!(ordered(&mut honest, &releases, DIRECTIVE, &first, 3), Some(Code::BadSignature));
}

#[test]
fn a_robot_that_a_thief_of_the_directive_key_keeps_from_the_change_obeys_him_for_a_day_at_most() {
    // What the robot sees is what there was before the change: it never comes to it.
    let releases = Releases::new();
    let (first, second) = (releases.release("1.1.0"), releases.release("1.2.0"));
    let mut kept = robot(&releases, &second);
    assert_eq!(ordered(&mut kept, &releases, DIRECTIVE, &first, 2), None);
    kept.ms += DAY_MS;
    kept.connect();
    assert_eq!(ordered(&mut kept, &releases, DIRECTIVE, &second, 3), Some(Code::MetadataRefused));
    assert_eq!(ordered(&mut kept, &releases, DIRECTIVE, &first, 4), Some(Code::MetadataRefused));
}

#[test]
fn a_thief_of_the_root_key_has_every_robot_until_a_person_puts_a_new_trust_file_there() {
    let releases = Releases::new();
    let good = releases.release("1.1.0");
    let mut rig = robot(&releases, &good);
    releases.list_keys(1, &[9], DIRECTIVE);

    // He hands everything over to keys of his own. No robot can tell him from Ann, Ben and Cleo.
    releases.hand_over((21, 22), (23, 24));
    let evil = releases.release("6.6.6");
    assert_eq!(ordered(&mut rig, &releases, 9, &evil, 2), None, "a thief can replace everybody");
    assert_eq!(state(&rig), Some(UpdateState::Staged));

    // A new project: no robot goes over to it by itself.
    releases.begin((31, 32), (33, 34));
    let anew = releases.release("2.0.0");
    releases.trust(NEW_DIRECTIVE);
    assert_eq!(ordered(&mut rig, &releases, NEW_DIRECTIVE, &anew, 3), Some(Code::MetadataRefused));

    // The new trust file is put there, and the agent is started again.
    let mut rig = rig.restart();
    rig.connect();
    assert_eq!(ordered(&mut rig, &releases, 9, &anew, 4), Some(Code::BadSignature), "the key of before");
    assert_eq!(ordered(&mut rig, &releases, NEW_DIRECTIVE, &evil, 5), Some(Code::DirectiveRefused), "nobody lists it");
    assert_eq!(ordered(&mut rig, &releases, NEW_DIRECTIVE, &anew, 6), None);
    assert_eq!(state(&rig), Some(UpdateState::Staged));
    releases.list_keys(1, &[10], NEW_DIRECTIVE);
    let next = releases.release("2.1.0");
    assert_eq!(ordered(&mut rig, &releases, 10, &next, 7), None, "its sets of keys begin with 1 again");

    // Started again with that file it stays with it, and the thief's documents are refused.
    let thiefs = Releases::new();
    thiefs.hand_over((21, 22), (23, 24));
    releases.replay(&thiefs.documents());
    let mut rig = rig.restart();
    rig.connect();
    assert_eq!(ordered(&mut rig, &releases, 10, &evil, 8), Some(Code::MetadataRefused));
}
