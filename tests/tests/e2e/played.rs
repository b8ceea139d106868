//! Robots that behave badly, over real sockets: the players of the simulation beside honest robots on real servers. What
//! one of them says harms nobody's work but its own, and no server.
//!
//! Each seed is a player with a certificate, a name and a few seconds of its own, with the habits of the first player of
//! that seed in the simulation. Then it is gone for ever, and a person does what a person can do about it. Many play at
//! once, so a finding names all that played on its server.

use crate::arena::Arena;
use crate::robots::enrolled;
use anyhow::{Context, ensure};
use midshift_agent::dial::TcpDial;
use midshift_core::ids::RobotId;
use midshift_tests::player::line::Line;
use midshift_tests::player::{Around, Player};
use std::collections::{BTreeMap, BTreeSet};
use std::ops::Range;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;
use tokio::task::JoinSet;

/// Seeds of a plain run.
const SEEDS: u64 = 100;
/// Runs with so many must have looked at every law.
const ENOUGH: u64 = 100;
/// Servers that the seeds are spread over.
const ARENAS: u64 = 4;
/// Players of one server at once.
const SEATS: usize = 5;
/// A player plays for so long.
const PLAYS: Duration = Duration::from_secs(8);
/// Between two looks.
const LOOK: Duration = Duration::from_secs(1);
/// Looks between two rounds of a person.
const LOOKS_PER_ROUND: u32 = 3;
/// When the last player is gone every task must end within this: longer than nobody knows where a robot's authority
/// ends, twice.
const ENDS_WITHIN: Duration = Duration::from_secs(120);

/// Laws that must have been looked at.
const LAWS: [&str; 12] = [
    "every task ends",
    "honest robots' tasks go on",
    "memory is bounded",
    "no place was too full",
    "no step is done twice",
    "nobody's work is given twice",
    "nothing panics",
    "nothing stands unexplained",
    "the server lives",
    "the server says why it ends a session",
    "what a person must solve has an incident",
    "what does not move is explained",
];

/// Who plays on one server, who has played, and what they did.
#[derive(Default)]
struct Players {
    playing: BTreeSet<String>,
    gone: BTreeSet<String>,
    deeds: BTreeMap<&'static str, u64>,
    ends: Vec<(String, Ends)>,
}

/// Attempts that a player ended, by name: how often, and whether as done.
type Ends = BTreeMap<String, (u64, bool)>;

type Shared = Arc<Mutex<Players>>;

fn lock<T>(what: &Mutex<T>) -> MutexGuard<'_, T> {
    what.lock().unwrap_or_else(PoisonError::into_inner)
}

/// One seed from its enrolment to its end.
async fn play(seed: u64, around: Around, at: Where, players: Shared) -> anyhow::Result<()> {
    let name = format!("player-{seed}");
    let robot_id = RobotId::parse(&name)?;
    let tls = enrolled(at.address, &robot_id).await?;
    let dial = TcpDial::new(&format!("https://{}", at.address), None)?.with_tls(tls);
    let player = Arc::new(Mutex::new(Player::of_seed(seed, 0, robot_id, around)));
    let line = Line::new(player.clone(), Arc::new(dial), at.clock.clone());
    lock(&players).playing.insert(name.clone());
    let _over = tokio::time::timeout(PLAYS, line.clone().play()).await;
    let mut players = lock(&players);
    lock(&player).deeds().iter().for_each(|(habit, n)| *players.deeds.entry(*habit).or_default() += n);
    players.ends.push((name.clone(), line.ends()));
    players.playing.remove(&name);
    players.gone.insert(name);
    Ok(())
}

/// The server that players dial, and their clock.
#[derive(Clone)]
struct Where {
    address: std::net::SocketAddr,
    clock: Arc<dyn midshift_core::time::Clock>,
}

/// Plays these seeds on one server; what was met, and what broke a law.
async fn arena(seeds: Range<u64>) -> anyhow::Result<(BTreeMap<&'static str, u64>, BTreeSet<String>)> {
    let mut arena = Arena::open(seeds.start).await?;
    let at = Where { address: arena.address(), clock: arena.clock.clone() };
    let players = Shared::default();
    let next = Arc::new(Mutex::new(seeds.clone()));
    let honest: Vec<RobotId> = arena.honest().iter().map(|id| RobotId::parse(id)).collect::<Result<_, _>>()?;
    let mut seats = JoinSet::new();
    for seat in 0..SEATS {
        let (site, honest, rumours) = (arena.site.clone(), honest.clone(), arena.rumours());
        let (next, at, players) = (next.clone(), at.clone(), players.clone());
        seats.spawn(async move {
            loop {
                let Some(seed) = lock(&next).next() else { return anyhow::Ok(()) };
                let around = Around::of_site(&site, seat, honest.clone(), rumours());
                play(seed, around, at.clone(), players.clone()).await.with_context(|| format!("seed {seed}"))?;
            }
        });
    }
    let mut look = tokio::time::interval(LOOK);
    let mut looks = 0;
    while !seats.is_empty() {
        tokio::select! {
            Some(ended) = seats.join_next() => ended??,
            _ = look.tick() => {
                looks += 1;
                arena.ask().await?;
                let (playing, gone) = { let p = lock(&players); (p.playing.clone(), p.gone.clone()) };
                arena.look_around(&playing).await?;
                if looks % LOOKS_PER_ROUND == 0 {
                    arena.look_after(&gone).await?;
                }
            }
        }
    }
    let gone = lock(&players).gone.clone();
    let end = tokio::time::Instant::now() + ENDS_WITHIN;
    // What is still open then is a finding, with its name.
    while !arena.look_after(&gone).await? && tokio::time::Instant::now() < end {
        look.tick().await;
        arena.look_around(&BTreeSet::new()).await?;
    }
    let ends = std::mem::take(&mut lock(&players).ends);
    ends.iter().for_each(|(robot_id, ends)| arena.ended(robot_id, ends));
    arena.judge(&gone).await?;
    let (mut met, findings) = arena.verdict();
    lock(&players).deeds.iter().for_each(|(habit, n)| *met.entry(*habit).or_default() += n);
    Ok((met, findings))
}

fn number(variable: &str) -> Option<u64> {
    std::env::var(variable).ok()?.parse().ok()
}

/// How to play seeds again.
fn again(seeds: &Range<u64>) -> String {
    let many = seeds.end - seeds.start;
    format!("cargo xtask torture sockets --from {} --seeds {many}", seeds.start)
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn robots_that_behave_badly_over_sockets_harm_no_honest_robot_and_no_server() -> anyhow::Result<()> {
    let from = number("MIDSHIFT_SEED_FROM").unwrap_or(1);
    let many = number("MIDSHIFT_SEEDS").unwrap_or(SEEDS);
    let arenas = ARENAS.min(many.div_ceil(SEATS as u64));
    let mut running = JoinSet::new();
    for nth in 0..arenas {
        let seeds = from + many * nth / arenas..from + many * (nth + 1) / arenas;
        running.spawn(async move {
            let again = again(&seeds);
            let of_seeds = arena(seeds).await;
            of_seeds.map(|(met, findings)| (met, findings, again.clone())).context(again)
        });
    }
    let (mut met, mut broken): (BTreeMap<&str, u64>, Vec<String>) = Default::default();
    while let Some(ended) = running.join_next().await {
        let (of_arena, findings, again) = ended??;
        of_arena.into_iter().for_each(|(what, n)| *met.entry(what).or_default() += n);
        broken.extend(findings.into_iter().map(|finding| format!("{finding}\n    again: {again}")));
    }
    ensure!(broken.is_empty(), "{} findings:\n{}", broken.len(), broken.join("\n"));
    say!("{many} seeds on {arenas} servers: {met:?}");
    // Which habits show depends on when who is asked for what; the simulation's run asks for each of them.
    let never: Vec<&str> = LAWS.into_iter().filter(|law| !met.contains_key(law)).collect();
    ensure!(never.is_empty() || many < ENOUGH, "{many} seeds and never: {never:#?}");
    Ok(())
}
