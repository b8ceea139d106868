//! The file of a robot's stops through the life of an agent that is killed at any of its calls that change the disk.
//!
//! Without being asked a seeded sample of the calls is cut; `MIDSHIFT_SITES=all` cuts every one. A write of which half
//! arrives is the latch file's own test.

#![expect(clippy::print_stdout, reason = "the one that is killed says what it has done")]

use crate::strace::{Sites, Victim, killed_after, sites};
use midshift_agent::stop::storage::{FileStops, Loaded, STOP_FILE, StopStorage, unreadable};
use midshift_core::ids::{RobotId, StopId};
use midshift_core::robot::StopLevel;
use midshift_core::stop::ladder::Around;
use midshift_core::stop::robot::{RobotStop, SavedStops};
use midshift_core::stop::{Reset, Scope, Stop};
use midshift_core::time::{LinkTime, Now, SiteTime, Utc};
use rand::SeedableRng;
use rand::rngs::StdRng;
use rand::seq::SliceRandom;
use std::fs;
use std::path::Path;

/// Names the folder to the process that is to be killed.
const LIFE_IN: &str = "MIDSHIFT_TEST_STOPS_IN";
/// The test that lives there.
const LIVES: &str = "stop_cuts::a_file_of_stops_lived_through_once_more_says_the_same";
/// Cuts of a sample.
const SAMPLE: usize = 8;
/// What a file is that cannot be read.
const BROKEN: [u8; 4096] = [7; 4096];

/// What comes to a robot.
#[derive(Clone)]
enum News {
    Told(Vec<Stop>, Vec<Reset>),
    Resumed(StopId),
    /// Its agent ends in order and begins again.
    Restart,
}

fn id(name: &str) -> StopId {
    StopId::parse(name).expect("an id")
}

fn stop(name: &str, scope: Scope, level: StopLevel) -> News {
    let (actor, reason) = ("who".to_owned(), "why".to_owned());
    let stop = Stop { actor, reason, proof: vec![9; 64], ..Stop::new(id(name), scope, level, Utc(5)) };
    News::Told(vec![stop], Vec::new())
}

fn reset(names: &[&str]) -> News {
    let reset = |name: &&str| {
        let (actor, reason) = ("who".to_owned(), "all clear".to_owned());
        Reset { actor, reason, ..Reset::new(id(name), Utc(6)) }
    };
    News::Told(Vec::new(), names.iter().map(reset).collect())
}

fn robot_id() -> RobotId {
    RobotId::parse("r1").expect("an id")
}

fn all_news() -> Vec<News> {
    use StopLevel::{ControlledStopPosture, Halt, Slow};
    vec![
        stop("STOP-A", Scope::Fleet, Halt),
        stop("STOP-B", Scope::Robot(robot_id()), ControlledStopPosture),
        reset(&["STOP-A"]),
        News::Resumed(id("STOP-A")),
        stop("STOP-C", Scope::Fleet, Slow),
        News::Restart,
        reset(&["STOP-B", "STOP-C"]),
        News::Resumed(id("STOP-B")),
        stop("STOP-D", Scope::Fleet, Halt),
    ]
}

/// One robot that hears; whether there is something to keep.
fn hear_news(robot: &mut RobotStop, news: &News) -> bool {
    let now = Now { link: LinkTime(10), site: SiteTime(10), utc: Utc(1_000), wall: Utc(1_000), jump: None };
    let is_new = match news {
        News::Told(stops, resets) => robot.merge_changes(stops.clone(), resets.clone()),
        News::Resumed(stop_id) => robot.resumed(&[stop_id.clone()].into()),
        News::Restart => {
            *robot = begun(robot.saved().clone());
            false
        }
    };
    robot.advance(&now, None, Around::People).is_changed | is_new
}

fn begun(saved: SavedStops) -> RobotStop {
    RobotStop::begin(robot_id(), saved, LinkTime(10))
}

/// What is kept one after the other, from `first` on.
fn states(first: SavedStops) -> Vec<SavedStops> {
    let (mut robot, mut states) = (begun(first.clone()), vec![first]);
    for news in all_news() {
        if hear_news(&mut robot, &news) {
            states.push(robot.saved().clone());
        }
    }
    states
}

/// What a robot begins with whose file cannot be read.
fn stands() -> SavedStops {
    unreadable(&robot_id(), Utc(7))
}

fn load(folder: &Path) -> (FileStops, Loaded) {
    let mut file = FileStops::new(&folder.join(STOP_FILE));
    let loaded = wait(file.load(stands()));
    (file, loaded)
}

fn wait<T>(future: impl Future<Output = T>) -> T {
    tokio::runtime::Builder::new_current_thread().build().expect("a runtime").block_on(future)
}

/// The life of an agent's file. Each line says what is durable.
fn live(folder: &Path) {
    let (mut file, loaded) = load(folder);
    assert!(loaded.is_durable);
    println!("+{}", serde_json::to_string(&loaded.saved).expect("JSON"));
    let mut robot = begun(loaded.saved);
    for news in all_news() {
        if matches!(news, News::Restart) {
            let loaded;
            drop(file);
            (file, loaded) = load(folder);
            assert_eq!(loaded, Loaded { saved: robot.saved().clone(), is_durable: true });
        }
        if hear_news(&mut robot, &news) {
            wait(file.save(robot.saved().clone())).expect("keeps");
            println!("+{}", serde_json::to_string(robot.saved()).expect("JSON"));
        }
    }
}

#[test]
fn a_file_of_stops_lived_through_once_more_says_the_same() {
    if let Some(folder) = std::env::var_os(LIFE_IN) {
        // In the process that is to be killed.
        return live(Path::new(&folder));
    }
    let folder = tempfile::tempdir().expect("a folder");
    let last = states(SavedStops::default()).pop().expect("an end");
    assert!(last.latch.is_effective(&id("STOP-D")) && last.latch.effective().count() == 1);
    assert_eq!(last.awaiting, [id("STOP-D")].into());
    for _ in 0..2 {
        live(folder.path());
        assert_eq!(load(folder.path()).1.saved, last);
    }
}

/// Cuts the life of a file that is made, or that was broken; how many cuts.
fn cut(is_broken: bool) -> usize {
    let seed = std::env::var("MIDSHIFT_SEED").ok().and_then(|seed| seed.parse().ok()).unwrap_or(1);
    let all = std::env::var("MIDSHIFT_SITES").is_ok_and(|sites| sites == "all");
    let folder = || {
        let folder = tempfile::tempdir().expect("a folder");
        if is_broken {
            fs::write(folder.path().join(STOP_FILE), BROKEN).expect("writes");
        }
        folder
    };
    let states = states(if is_broken { stands() } else { SavedStops::default() });
    let last = states.last().expect("an end");
    let home = folder();
    let at = |folder: &Path| [(LIFE_IN, folder.as_os_str().to_owned())];
    let Sites { calls, paths } = sites(&Victim { test: LIVES, environment: &at(home.path()), folder: home.path() });
    let found = calls.len();
    assert!(found >= 2 * states.len(), "{found} calls change the disk: {calls:?}");
    let mut cuts: Vec<usize> = (1..=found).collect();
    if !all {
        cuts.shuffle(&mut StdRng::seed_from_u64(seed));
        cuts.truncate(SAMPLE);
    }
    for cut in &cuts {
        let when = format!("broken: {is_broken}, killed after call {cut}, {:?}, MIDSHIFT_SEED={seed}", calls[cut - 1]);
        let home = folder();
        let victim = Victim { test: LIVES, environment: &at(home.path()), folder: home.path() };
        let said = killed_after(&victim, &paths, *cut);
        let durable: Vec<SavedStops> = said
            .lines()
            .filter_map(|line| line.strip_prefix('+'))
            .map(|line| serde_json::from_str(line).expect("whole"))
            .collect();
        // A restart says what it found, which was said before.
        let newest =
            durable.last().map_or(0, |saved| states.iter().position(|state| state == saved).expect("one of them"));
        let (_, loaded) = load(home.path());
        assert!(loaded.is_durable, "{when}");
        let at = states.iter().position(|state| *state == loaded.saved);
        assert!(at.is_some_and(|at| (newest..=newest + 1).contains(&at)), "{when}: {newest} was kept, {at:?} is there");
        let beside = home.path().join(STOP_FILE).with_extension("latch.broken");
        assert!(!is_broken || fs::read(beside).is_ok_and(|bytes| bytes == BROKEN), "{when}: what was broken is kept");
        // Said once more it comes to the same, and the facts do so in any order.
        let (mut again, mut backwards) = (begun(loaded.saved.clone()), begun(loaded.saved));
        for news in all_news() {
            hear_news(&mut again, &news);
        }
        for news in all_news().iter().rev() {
            hear_news(&mut backwards, news);
        }
        assert_eq!(again.saved(), last, "{when}");
        assert_eq!(backwards.saved().latch, last.latch, "{when}");
    }
    println!(
        "broken: {is_broken}: {found} calls change the disk; {} of them were cut; MIDSHIFT_SEED={seed}",
        cuts.len()
    );
    cuts.len()
}

#[test]
fn wherever_an_agent_is_killed_its_file_has_every_stop_that_it_said_it_keeps() {
    assert!(cut(false) >= SAMPLE);
}

#[test]
fn wherever_an_agent_is_killed_that_cannot_read_its_file_it_stands_until_a_person_resumes_it() {
    assert!(cut(true) >= SAMPLE);
}
