//! What a robot says it has installed.

use midshift_bundle::installed::{Rejection, open, seal};
use midshift_bundle::keys::SecretKey;
use midshift_core::ids::{BundleId, RobotId, SetId};
use midshift_core::limits;
use midshift_core::update::{Installed, InstalledSet};

fn robot() -> RobotId {
    RobotId::parse("rbt-01").expect("a name")
}

fn set(number: usize, components: usize) -> InstalledSet {
    let letters = |letter: &str, count: usize| letter.repeat(count);
    InstalledSet {
        set: SetId::parse(&format!("{number:064x}")).expect("a set"),
        bundle: Some(BundleId::parse(&letters("b", 64)).expect("a bundle")),
        version: letters("v", 129),
        components: (0..components).map(|n| (format!("{n:064}"), letters("1", 64))).collect(),
        components_left_out: 3,
    }
}

/// All that may be said, at its longest.
fn longest() -> Installed {
    Installed {
        robot_id: robot(),
        boot_id: "b".repeat(64),
        device_key: String::new(),
        model: "m".repeat(64),
        free_bytes: u64::MAX,
        running: SetId::parse(&"1".repeat(64)).expect("a set"),
        current: SetId::parse("factory").expect("a set"),
        previous: Some(SetId::parse(&"2".repeat(64)).expect("a set")),
        sets: (0..limits::INSTALLED_SETS_MAX).map(|n| set(n, limits::INSTALLED_COMPONENTS_MAX)).collect(),
    }
}

#[test]
fn what_a_robot_signs_is_read_back_also_at_its_longest() {
    let key = SecretKey::of_seed([4; 32]);
    let envelope = seal(longest(), &key);
    assert!(envelope.len() <= limits::INSTALLED_BYTES_MAX, "{} bytes", envelope.len());
    let read = open(&envelope, &robot(), &longest().boot_id).expect("believed");
    assert_eq!(read, Installed { device_key: key.public().hex(), ..longest() });
}

#[test]
fn what_another_robot_start_or_key_signed_is_not_believed() {
    let key = SecretKey::of_seed([4; 32]);
    let (envelope, boot_id) = (seal(longest(), &key), longest().boot_id);
    let other = RobotId::parse("rbt-02").expect("a name");
    assert_eq!(open(&envelope, &other, &boot_id), Err(Rejection::OtherRobot));
    assert_eq!(open(&envelope, &robot(), "another"), Err(Rejection::OtherStart));
    // The envelope of one key with the signature of another.
    let foreign = seal(longest(), &SecretKey::of_seed([5; 32]));
    let (from, to) =
        ("\"signatures\":", |text: &str| text.split_once("\"signatures\":").expect("has some").1.to_owned());
    let mixed = format!("{}{from}{}", envelope.split_once(from).expect("has some").0, to(&foreign));
    assert_eq!(open(&mixed, &robot(), &boot_id), Err(Rejection::NotSigned));
    assert_eq!(open("{}", &robot(), &boot_id), Err(Rejection::Malformed));
    let typed = envelope.replace("installed.v1", "directive.v1");
    assert_eq!(open(&typed, &robot(), &boot_id), Err(Rejection::OtherType));
    let long = format!("{envelope}{}", " ".repeat(limits::INSTALLED_BYTES_MAX));
    assert_eq!(open(&long, &robot(), &boot_id), Err(Rejection::TooLong));
}

#[test]
fn more_than_may_be_listed_is_refused_though_it_is_signed() {
    let key = SecretKey::of_seed([4; 32]);
    let small = Installed { sets: vec![set(1, 1)], ..longest() };
    let wrong: [fn(&mut Installed); 4] = [
        |i| i.sets = (0..=limits::INSTALLED_SETS_MAX).map(|n| set(n, 1)).collect(),
        |i| i.sets = vec![set(1, limits::INSTALLED_COMPONENTS_MAX + 1)],
        |i| i.sets = vec![set(1, 1), set(1, 1)],
        |i| i.model = "m".repeat(65),
    ];
    for change in wrong {
        let mut installed = small.clone();
        change(&mut installed);
        let opened = open(&seal(installed, &key), &robot(), &small.boot_id);
        assert!(matches!(opened, Err(Rejection::Refused(_))), "{opened:?}");
    }
    assert!(open(&seal(small.clone(), &key), &robot(), &small.boot_id).is_ok());
}
