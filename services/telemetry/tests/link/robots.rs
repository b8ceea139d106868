//! The projection of robots that people and programs see.

use crate::world::{Result, Robot, World, clock, serve, world};
use midshift_core::fleet::rows::RobotControl;
use midshift_core::ids::{RobotId, SiteId};
use midshift_core::item::Item;
use midshift_core::presence::{LastHeard, PresenceRow};
use midshift_core::robot::{Inventory, Mode, ReportedState, Vitals};
use midshift_core::rows::Writer;
use midshift_core::session::Session;
use midshift_core::time::Clock;
use midshift_proto::access::local;
use midshift_proto::convert::{ms_of, time_of};
use midshift_proto::telemetry::v1::telemetry_service_client::TelemetryServiceClient;
use midshift_proto::telemetry::v1::telemetry_service_server::TelemetryService;
use midshift_proto::telemetry::v1::{
    self, GetRobotRequest, ListRobotsRequest, Presence, RobotFilter, WatchRobotsRequest, WatchRobotsResponse,
};
use midshift_store::{LiveBoard, MemoryFrames, MemoryStore, Store, StoreId};
use midshift_telemetry::{Bugs, Parts};
use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;
use tokio_stream::StreamExt;
use tonic::Streaming;

struct Watcher(Streaming<WatchRobotsResponse>);

impl Watcher {
    async fn of(world: &World, presences: &[Presence]) -> Result<Self> {
        let presences = presences.iter().map(|p| (*p).into()).collect();
        Self::over(world, RobotFilter { presences, ..RobotFilter::default() }).await
    }
    async fn over(world: &World, filter: RobotFilter) -> Result<Self> {
        let mut client = TelemetryServiceClient::new(world.channel.clone());
        let request = WatchRobotsRequest { filter: Some(filter), period_ms: 50 };
        Ok(Self(client.watch_robots(request).await?.into_inner()))
    }
    async fn next(&mut self) -> Result<WatchRobotsResponse> {
        self.0.message().await?.ok_or_else(|| "the watch ended".into())
    }
    /// The next presence that is told of the one robot.
    async fn presence(&mut self) -> Result<Presence> {
        loop {
            if let Some(robot) = self.next().await?.robots.first() {
                return Ok(robot.presence());
            }
        }
    }
    /// The next that differs from `last`.
    async fn after(&mut self, last: Presence) -> Result<Presence> {
        loop {
            let presence = self.presence().await?;
            if presence != last {
                return Ok(presence);
            }
        }
    }
}

#[tokio::test(start_paused = true)]
async fn robots_are_listed_by_the_beginning_of_their_id() -> Result<()> {
    let world = world().await?;
    let _robot = Robot::attach(&world, None).await?;
    for (prefix, expected) in [("", true), ("r", true), ("r1", true), ("r10", false), ("s", false)] {
        let filter = Some(RobotFilter { robot_id_prefix: prefix.to_owned(), ..RobotFilter::default() });
        let request = ListRobotsRequest { filter, ..ListRobotsRequest::default() };
        let mut client = TelemetryServiceClient::new(world.channel.clone());
        let robots = client.list_robots(request).await?.into_inner().robots;
        assert_eq!(robots.iter().any(|robot| robot.robot_id == "r1"), expected, "{prefix}");
    }
    Ok(())
}

#[tokio::test(start_paused = true)]
async fn a_watcher_sees_a_robot_fall_silent() -> Result<()> {
    let world = world().await?;
    let mut robot = Robot::attach(&world, None).await?;
    let mut watcher = Watcher::of(&world, &[]).await?;
    robot.beat().await?;
    let mut seen = vec![watcher.after(Presence::Offline).await?];
    for _ in 0..2 {
        let last = seen.last().copied().unwrap_or_default();
        seen.push(watcher.after(last).await?);
    }
    assert_eq!(seen, [Presence::Online, Presence::Suspect, Presence::Offline]);
    Ok(())
}

#[tokio::test(start_paused = true)]
async fn a_robot_that_leaves_the_filter_is_told_once_more_and_then_no_more_until_it_is_back() -> Result<()> {
    let world = world().await?;
    let mut robot = Robot::attach(&world, None).await?;
    robot.beat().await?;
    let mut watcher = Watcher::of(&world, &[Presence::Online]).await?;
    let mut all = Watcher::of(&world, &[]).await?;
    assert_eq!(watcher.after(Presence::Unspecified).await?, Presence::Online);
    assert_eq!(watcher.after(Presence::Online).await?, Presence::Suspect);
    // Offline is told to whoever asked for everything, and not to this watcher.
    while all.presence().await? != Presence::Suspect {}
    while all.presence().await? != Presence::Offline {}
    robot.beat().await?;
    assert_eq!(watcher.presence().await?, Presence::Online);
    Ok(())
}

#[tokio::test(start_paused = true)]
async fn the_mark_of_the_whole_stays() -> Result<()> {
    let world = world().await?;
    let mut watcher = Watcher::of(&world, &[]).await?;
    assert!(watcher.next().await?.snapshot_complete);
    let mut robot = Robot::attach(&world, None).await?;
    robot.beat().await?;
    let later = watcher.next().await?;
    assert!(later.snapshot_complete && !later.robots.is_empty());
    Ok(())
}

async fn get(world: &World) -> Result<v1::Robot> {
    let request = GetRobotRequest { robot_id: "r1".to_owned() };
    let answer = TelemetryServiceClient::new(world.channel.clone()).get_robot(request).await?.into_inner();
    answer.robot.ok_or_else(|| "no robot".into())
}

/// A server that begins on what another one left.
async fn begin(store: &Arc<dyn Store>, clock: &Arc<dyn Clock>) -> Result<World> {
    let frames = Arc::new(MemoryFrames::new(clock.clone(), 1 << 20));
    let (store, clock, bugs) = (store.clone(), clock.clone(), Bugs::default());
    serve(Parts { store, frames, board: LiveBoard::new(), heard: None, clock, bugs }).await
}

#[tokio::test(start_paused = true)]
async fn a_robot_is_offline_after_a_start_with_what_was_known_of_it_until_it_is_heard() -> Result<()> {
    let clock = clock();
    let store: Arc<dyn Store> =
        Arc::new(MemoryStore::new(SiteId::parse("s")?, StoreId(Arc::from("store-1")), clock.clone()));
    let first = begin(&store, &clock).await?;
    let mut robot = Robot::attach(&first, None).await?;
    let mut watcher = Watcher::of(&first, &[]).await?;
    let vitals = Vitals { battery_permille: 640, ..Vitals::default() };
    let manual = || ReportedState { mode: Mode::Manual, vitals: vitals.clone(), ..ReportedState::default() };
    robot.beat_saying(manual(), None).await?;
    assert_eq!(watcher.after(Presence::Offline).await?, Presence::Online);
    let before = get(&first).await?;
    assert_eq!(before.conditions.iter().map(|c| c.what.as_str()).collect::<Vec<_>>(), ["manual"]);
    assert_eq!(before.last_heard, None);
    let proof = robot.proof();
    first.end.cancel();

    tokio::time::advance(Duration::from_secs(20)).await;
    let second = begin(&store, &clock).await?;
    let mut watcher = Watcher::of(&second, &[]).await?;
    assert_eq!(watcher.presence().await?, Presence::Offline);
    let shown = get(&second).await?;
    assert_eq!((shown.presence(), &shown.reported, &shown.age), (Presence::Offline, &None, &None));
    assert_eq!(shown.presence_since, before.receive_time, "it was heard then");
    let last = shown.last_heard.ok_or("nothing is known")?;
    assert_eq!((last.battery_permille, last.receive_time), (640, before.receive_time));
    assert!(last.age.as_ref().map(ms_of) >= Some(20_000), "{:?}", last.age);
    assert_eq!(shown.conditions, before.conditions, "as it was heard last");
    let mut online = Watcher::of(&second, &[Presence::Online]).await?;
    assert!(online.next().await?.robots.is_empty());

    let mut robot = Robot::attach(&second, Some(proof)).await?;
    robot.beat_saying(manual(), None).await?;
    assert_eq!(watcher.after(Presence::Offline).await?, Presence::Online);
    let heard = get(&second).await?;
    assert_eq!((&heard.last_heard, &heard.conditions), (&None, &before.conditions), "it never said otherwise");
    assert!(heard.reported.is_some());
    Ok(())
}

/// A session that a robot had once.
fn session(id: &str, inventory: Inventory) -> Result<Session> {
    Ok(Session {
        secret: "secret".into(),
        boot_id: "b-1".to_owned(),
        ring: "ring".to_owned(),
        ..Session::new(RobotId::parse(id)?, 7, inventory)
    })
}

/// Pages of two robots each that a filter admits: none is empty while there are more.
async fn paged(world: &World, filter: RobotFilter) -> Result<Vec<String>> {
    let mut client = TelemetryServiceClient::new(world.channel.clone());
    let (mut ids, mut page_token) = (Vec::new(), String::new());
    loop {
        let request = ListRobotsRequest { filter: Some(filter.clone()), page_size: 2, page_token };
        let page = client.list_robots(request).await?.into_inner();
        assert!(page.next_page_token.is_empty() || page.robots.len() == 2, "{filter:?}: {ids:?}");
        ids.extend(page.robots.into_iter().map(|robot| robot.robot_id));
        page_token = page.next_page_token;
        if page_token.is_empty() {
            return Ok(ids);
        }
    }
}

#[tokio::test(start_paused = true)]
async fn pages_of_robots_are_full_as_long_as_more_match_and_the_last_one_says_so() -> Result<()> {
    let clock = clock();
    let store: Arc<dyn Store> =
        Arc::new(MemoryStore::new(SiteId::parse("s")?, StoreId(Arc::from("store-1")), clock.clone()));
    let mut item = Item::new(Writer::Telemetry, "tests");
    for n in 1..=12 {
        let line = if n % 5 == 0 { "b" } else { "a" };
        let labels = [("line".to_owned(), line.to_owned())].into();
        item.create(&session(&format!("r{n}"), Inventory { labels, ..Inventory::default() })?, "session.opened");
    }
    assert!(store.commit(vec![item]).await.iter().all(|applied| applied.is_ok()));
    let world = begin(&store, &clock).await?;
    assert_eq!(Watcher::of(&world, &[]).await?.presence().await?, Presence::Offline);
    let all = ["r1", "r10", "r11", "r12", "r2", "r3", "r4", "r5", "r6", "r7", "r8", "r9"];
    assert_eq!(paged(&world, RobotFilter::default()).await?, all);
    let labels = [("line".to_owned(), "b".to_owned())].into();
    assert_eq!(paged(&world, RobotFilter { labels, ..RobotFilter::default() }).await?, ["r10", "r5"]);
    let robot_ids = ["r9", "r2", "R!", "r99", "r11"].map(str::to_owned).to_vec();
    assert_eq!(paged(&world, RobotFilter { robot_ids, ..RobotFilter::default() }).await?, ["r11", "r2", "r9"]);
    for (prefix, begin) in [("r1", &all[..4]), ("r12", &all[3..4]), ("r13", &all[..0]), ("R!", &all[..0])] {
        let filter = RobotFilter { robot_id_prefix: prefix.to_owned(), ..RobotFilter::default() };
        assert_eq!(paged(&world, filter).await?, begin, "{prefix}");
    }
    let presences = vec![Presence::Online.into()];
    assert!(paged(&world, RobotFilter { presences, ..RobotFilter::default() }).await?.is_empty());
    Ok(())
}

/// Robots open sessions and are not heard.
async fn open(store: &dyn Store, ids: &[String]) -> Result<()> {
    let mut item = Item::new(Writer::Telemetry, "tests");
    for id in ids {
        item.create(&session(id, Inventory::default())?, "session.opened");
    }
    assert!(store.commit(vec![item]).await.iter().all(|applied| applied.is_ok()));
    Ok(())
}

#[tokio::test(start_paused = true)]
async fn robots_that_change_or_come_while_the_whole_is_told_are_told_once_more_and_none_is_left_out() -> Result<()> {
    let clock = clock();
    let store: Arc<dyn Store> =
        Arc::new(MemoryStore::new(SiteId::parse("s")?, StoreId(Arc::from("store-1")), clock.clone()));
    let ids = |numbers: std::ops::RangeInclusive<u32>| numbers.map(|n| format!("r{n:02}")).collect::<Vec<_>>();
    open(&*store, &ids(1..=60)).await?;
    let world = begin(&store, &clock).await?;
    while paged(&world, RobotFilter::default()).await?.len() < 60 {}
    // Not over a connection, which reads ahead: a message is composed once it is asked for.
    let request = WatchRobotsRequest { period_ms: 50, ..WatchRobotsRequest::default() };
    let mut watch = world.service.watch_robots(local(request)).await?.into_inner();
    let mut next = async || -> Result<(Vec<String>, bool)> {
        let told = watch.next().await.ok_or("the watch ended")??;
        Ok((told.robots.into_iter().map(|robot| robot.robot_id).collect(), told.snapshot_complete))
    };
    assert_eq!(next().await?, (ids(1..=24), false));

    // One that was told changes and one that was not; one comes before those that were told and one behind them.
    let mut item = Item::new(Writer::Fleet, "tests");
    for id in ["r03", "r30"] {
        let labels = BTreeMap::from([("floor".to_owned(), "2".to_owned())]);
        item.create(&RobotControl { labels, ..RobotControl::new(RobotId::parse(id)?) }, "robot.labeled");
    }
    assert!(store.commit(vec![item]).await.iter().all(|applied| applied.is_ok()));
    open(&*store, &["r00", "r24-b"].map(str::to_owned)).await?;
    while paged(&world, RobotFilter::default()).await?.len() < 62 {}
    assert_eq!(next().await?, ([vec!["r24-b".to_owned()], ids(25..=47)].concat(), false));
    assert_eq!(next().await?, (ids(48..=60), true));
    assert_eq!(next().await?, (["r00", "r03", "r24-b", "r30"].map(str::to_owned).to_vec(), true));
    assert!(tokio::time::timeout(Duration::from_secs(20), next()).await.is_err(), "each once, and nobody else");
    Ok(())
}

#[tokio::test(start_paused = true)]
async fn a_label_of_a_person_brings_a_robot_that_is_not_heard_into_a_list_and_a_watch_and_out_again() -> Result<()> {
    let clock = clock();
    let store: Arc<dyn Store> =
        Arc::new(MemoryStore::new(SiteId::parse("s")?, StoreId(Arc::from("store-1")), clock.clone()));
    let mut item = Item::new(Writer::Telemetry, "tests");
    item.create(&session("r1", Inventory::default())?, "session.opened");
    assert!(store.commit(vec![item]).await.iter().all(|applied| applied.is_ok()));
    let world = begin(&store, &clock).await?;
    assert_eq!(Watcher::of(&world, &[]).await?.presence().await?, Presence::Offline);
    let labels = || BTreeMap::from([("floor".to_owned(), "2".to_owned())]);
    let filter = || RobotFilter { labels: labels(), ..RobotFilter::default() };
    let mut watcher = Watcher::over(&world, filter()).await?;
    assert!(watcher.next().await?.robots.is_empty(), "nobody has said that of it");
    // By the paused clock: nothing else is going to happen.
    let mut told = async || tokio::time::timeout(Duration::from_secs(60), watcher.presence()).await;

    let mut item = Item::new(Writer::Fleet, "tests");
    let control = RobotControl { labels: labels(), ..RobotControl::new(RobotId::parse("r1")?) };
    item.create(&control, "robot.labeled");
    assert!(store.commit(vec![item]).await.iter().all(|applied| applied.is_ok()));
    assert_eq!(told().await??, Presence::Offline);
    assert_eq!(paged(&world, filter()).await?, ["r1"]);

    let (control, at) = midshift_store::load::<RobotControl>(&*store, "r1").await?.ok_or("no row")?;
    let mut item = Item::new(Writer::Fleet, "tests");
    item.update(&RobotControl { labels: BTreeMap::new(), ..control }, at, "robot.labeled");
    assert!(store.commit(vec![item]).await.iter().all(|applied| applied.is_ok()));
    assert_eq!(told().await??, Presence::Offline, "once more, since it is shown no more");
    assert!(paged(&world, filter()).await?.is_empty());
    Ok(())
}

/// Rows of a robot that was heard three days ago, as a backup of that moment has them; when that was, unix milliseconds.
async fn restore(store: &dyn Store, clock: &dyn Clock) -> Result<i64> {
    let heard_unix_ms = clock.now().wall.0 - 3 * 86_400_000;
    let robot_id = RobotId::parse("r1")?;
    let last_heard = LastHeard { at_unix_ms: heard_unix_ms, battery_permille: 640, waypoint: None };
    let online = midshift_core::presence::Presence::Online;
    let presence = PresenceRow::new(robot_id, online, heard_unix_ms - 1_000);
    let mut item = Item::new(Writer::Telemetry, "tests");
    item.create(&session("r1", Inventory::default())?, "session.opened");
    item.create(&PresenceRow { last_heard: Some(last_heard), ..presence }, "presence.changed");
    assert!(store.commit(vec![item]).await.iter().all(|applied| applied.is_ok()));
    Ok(heard_unix_ms)
}

#[tokio::test(start_paused = true)]
async fn a_robot_of_a_backup_is_listed_as_offline_since_it_was_heard_and_never_as_it_was_then() -> Result<()> {
    let clock = clock();
    let store: Arc<dyn Store> =
        Arc::new(MemoryStore::new(SiteId::parse("s")?, StoreId(Arc::from("store-1")), clock.clone()));
    let heard_unix_ms = restore(&*store, &*clock).await?;
    let world = begin(&store, &clock).await?;
    assert_eq!(Watcher::of(&world, &[]).await?.presence().await?, Presence::Offline);
    let mut client = TelemetryServiceClient::new(world.channel.clone());
    for (presences, shown) in
        [(vec![], 1), (vec![Presence::Online, Presence::Suspect], 0), (vec![Presence::Offline], 1)]
    {
        let presences = presences.into_iter().map(i32::from).collect();
        let filter = Some(RobotFilter { presences, ..RobotFilter::default() });
        let request = ListRobotsRequest { filter, ..ListRobotsRequest::default() };
        let page = client.list_robots(request).await?.into_inner();
        assert_eq!((page.robots.len(), page.next_page_token.as_str()), (shown, ""));
        for robot in page.robots {
            assert_eq!((robot.presence(), robot.reported, robot.age), (Presence::Offline, None, None));
            assert_eq!(robot.presence_since.as_ref().map(time_of).map(|at| at.0), Some(heard_unix_ms));
            let age_ms = robot.last_heard.and_then(|last| last.age).as_ref().map(ms_of);
            assert!(age_ms >= Some(3 * 86_400_000), "{age_ms:?}");
        }
    }
    // Nor does the row say so for ever.
    let kept = async || -> Result<_> {
        let row = midshift_store::load::<PresenceRow>(&*store, "r1").await?;
        Ok(row.map(|(row, _)| (row.presence, row.since_unix_ms)))
    };
    let offline = Some((midshift_core::presence::Presence::Offline, heard_unix_ms));
    for _ in 0..60 {
        if kept().await? == offline {
            return Ok(());
        }
        tokio::time::sleep(Duration::from_secs(1)).await;
    }
    Err(format!("{:?}", kept().await?).into())
}

#[tokio::test(start_paused = true)]
async fn what_keeps_a_robot_from_work_is_told_with_since_when_it_says_so() -> Result<()> {
    let world = world().await?;
    let mut robot = Robot::attach(&world, None).await?;
    robot.beat_saying(ReportedState { mode: Mode::Manual, ..ReportedState::default() }, None).await?;
    let mut watcher = Watcher::of(&world, &[]).await?;
    watcher.after(Presence::Offline).await?;
    let manual = get(&world).await?;
    tokio::time::advance(Duration::from_secs(2)).await;
    let stop_level = midshift_core::robot::StopLevel::Halt;
    robot.beat_saying(ReportedState { mode: Mode::Manual, stop_level, ..ReportedState::default() }, None).await?;
    while watcher.next().await?.robots.iter().all(|r| r.conditions.len() < 2) {}
    let both = get(&world).await?;
    let since = |robot: &v1::Robot, what: &str| {
        let found = robot.conditions.iter().find(|c| c.what == what);
        found.and_then(|c| c.since.as_ref()).map(time_of)
    };
    assert_eq!(both.conditions.iter().map(|c| c.what.as_str()).collect::<Vec<_>>(), ["stop halt", "manual"]);
    assert_eq!(since(&both, "manual"), since(&manual, "manual"), "it goes on since then");
    assert_eq!(since(&both, "stop halt"), both.receive_time.as_ref().map(time_of));
    Ok(())
}

#[tokio::test(start_paused = true)]
async fn a_clone_is_seen_beside_its_robot_and_changes_nothing_of_it() -> Result<()> {
    let world = world().await?;
    let mut robot = Robot::attach(&world, None).await?;
    robot.beat().await?;
    robot.hears(|down| down.echo).await?;
    assert!(!get(&world).await?.observed);
    let mut watcher = Watcher::of(&world, &[]).await?;
    let mut clone = Robot::attach(&world, None).await?;
    for _ in 0..3 {
        clone.beat().await?;
    }
    while !watcher.next().await?.robots.iter().any(|r| r.observed) {}
    let seen = get(&world).await?;
    assert!(seen.observed && seen.observed_since.is_some());
    assert_eq!(seen.session_epoch, robot.welcome.session_epoch);
    assert_eq!(seen.reported.map(|r| (r.hb, r.session_epoch)), Some((1, robot.welcome.session_epoch)));
    drop(clone);
    while watcher.next().await?.robots.iter().any(|r| r.observed) {}
    let seen = get(&world).await?;
    assert!(!seen.observed && seen.observed_since.is_none());
    Ok(())
}

#[tokio::test]
async fn a_beacon_of_a_known_robot_is_shown_as_a_hint_beside_its_presence_and_goes_when_the_robot_speaks() -> Result<()>
{
    let world = world().await?;
    let mut robot = Robot::attach(&world, None).await?;
    robot.beat().await?;
    robot.hears(|down| down.echo).await?;
    let beacons = tokio::net::UdpSocket::bind("127.0.0.1:0").await?;
    let address = beacons.local_addr()?;
    tokio::spawn(world.service.clone().hear_beacons(beacons));
    let launcher = tokio::net::UdpSocket::bind("127.0.0.1:0").await?;
    let before = get(&world).await?;
    assert_eq!(before.beacon, None);
    let seen = loop {
        for text in ["midshift-beacon 1 stranger v1 1 7\n", "nonsense", "midshift-beacon 1 r1 v1 2 7\n"] {
            launcher.send_to(text.as_bytes(), address).await?;
        }
        let seen = get(&world).await?;
        if seen.beacon.is_some() {
            break seen;
        }
        tokio::task::yield_now().await;
    };
    let beacon = seen.beacon.clone().ok_or("a beacon")?;
    assert_eq!((beacon.set_id.as_str(), beacon.tries), ("v1", 2));
    assert_eq!((seen.reported, seen.session_epoch), (before.reported, before.session_epoch), "nothing else changed");
    while get(&world).await?.beacon.is_some() {
        robot.beat().await?;
        robot.hears(|down| down.echo).await?;
    }
    Ok(())
}
