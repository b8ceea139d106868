//! Every method of every service asked by every role, in the whole site and in one area, by a robot and by nobody, on the server's port and on that of stops: who
//! is let in, and to what. All of it by the declaration alone: a method that is new is asked like the others, and one that cannot be asked fails the test.

use crate::anybody::{Method, Somebody, Words};
use crate::areas::{AREAS, PLACES, objects, shows, stop};
use crate::harness::{Server, folder, until};
use crate::robots::{Robots, enrolled};
use crate::rolled_out::{call, done};
use crate::stopped::StopServer;
use anyhow::{Context, ensure};
use midshift_core::identity::{Caller, Grant, HeldGrant, Object, Permission, Role, Scope, TokenId};
use midshift_core::ids::{AreaId, RobotId};
use midshift_core::reason::Code as Said;
use midshift_core::site::DEMO;
use midshift_proto::identity::v1::CreateTokenRequest;
use midshift_proto::identity::v1::identity_service_client::IdentityServiceClient;
use serde_json::{Value, json};
use std::collections::{BTreeMap, BTreeSet};
use std::net::SocketAddr;
use std::path::Path;
use std::time::Duration;
use tonic::Code;

const LIMIT: Duration = Duration::from_secs(60);
/// The robot that asks.
const ASKS: &str = "rbt-03";
/// Methods over objects whose requests name none, and why.
const NAME_NOTHING: [(&str, &str); 3] = [
    ("GetEncoding", "names a file: what is published is for every robot"),
    ("FetchChunks", "names a file: what is published is for every robot"),
    ("ListTaskTypes", "types are of the site, and whoever may read anything sees them"),
];
/// Methods that find nothing here even of what a caller may see, and why.
const NOTHING_HERE: [(&str, &str); 4] = [
    ("DisownAttempt", "robots list only what the server knows"),
    ("ListCounters", "nobody has worked"),
    ("ListQuarantines", "no release was bad"),
    ("LiftQuarantine", "no release was bad"),
];

/// Methods that act on what a filter admits of what the caller may act on, and pass over the rest without a word.
const FILTERED: [(&str, &str); 2] = [("CancelTasks", "tasks"), ("ResolveTasks", "tasks")];

fn is_listed(list: &[(&str, &str)], method: &Method) -> bool {
    list.iter().any(|(name, _)| *name == method.name())
}

/// A caller with its scope: none for a robot and for nobody.
type Holder = (Somebody, Option<Scope>);

/// Everybody, at one port.
fn everybody(
    port: SocketAddr,
    tokens: &BTreeMap<(Role, Scope), String>,
    robot: &midshift_agent::tls::Tls,
) -> anyhow::Result<Vec<Holder>> {
    let mut all = vec![
        (Somebody::new("nobody", Caller::nobody(), port, None)?, None),
        (Somebody::with(ASKS, Caller::robot(RobotId::parse(ASKS)?), port, robot.clone())?, None),
    ];
    for ((role, scope), token) in tokens {
        let grants = [HeldGrant::Known(Grant { role: *role, scope: scope.clone() })];
        let name = name(*role, scope);
        let caller = Caller::holder(TokenId::new("t1").context("an id")?, name.as_str().into(), grants.into(), false);
        all.push((Somebody::new(&name, caller, port, Some(token))?, Some(scope.clone())));
    }
    Ok(all)
}

fn name(role: Role, scope: &Scope) -> String {
    let place = if *scope == Scope::Site { "site" } else { AREAS[0] };
    format!("may-{}.{place}", role.as_str())
}

async fn tokens(server: &Server) -> anyhow::Result<BTreeMap<(Role, Scope), String>> {
    let mut identity = IdentityServiceClient::new(server.channel()?);
    let mut tokens = BTreeMap::new();
    for role in Role::ALL {
        for scope in [Scope::Site, Scope::Area(AreaId::parse(AREAS[0])?)] {
            // Of the whole site alone: no other token of them is given out.
            if scope != Scope::Site && matches!(role, Role::Admin | Role::Auditor) {
                continue;
            }
            let grant =
                if scope == Scope::Site { role.as_str().to_owned() } else { format!("{}@{}", role.as_str(), AREAS[0]) };
            let request = CreateTokenRequest {
                name: name(*role, &scope),
                grants: vec![grant],
                valid_seconds: 86_400,
                ..Default::default()
            };
            tokens.insert((*role, scope), identity.create_token(request).await?.into_inner().secret);
        }
    }
    Ok(tokens)
}

/// Nothing that is asked without words is done, and only who is declared to be let in is let in.
async fn asked_for_nothing(all: &[Holder], methods: &[Method]) -> anyhow::Result<usize> {
    let (mut wrong, mut refused) = (Vec::new(), 0);
    for (somebody, _) in all {
        for method in methods {
            let answer = somebody.asks(method, Vec::new(), 1).await?;
            let code = answer.as_ref().err().map(tonic::Status::code);
            let denied = code.filter(|code| matches!(code, Code::PermissionDenied | Code::Unauthenticated));
            let expected = somebody.refused(&method.path);
            refused += usize::from(expected.is_some());
            if denied != expected {
                wrong.push(format!("{} {}: {code:?}, and not {expected:?}", somebody.name, method.path));
            }
        }
    }
    ensure!(wrong.is_empty(), "{}", wrong.join("\n"));
    Ok(refused)
}

/// One call about something: what is wrong with its answer.
async fn asked_about(
    (somebody, scope): &Holder,
    method: &Method,
    is_own: bool,
    words: &Words,
    others: &Words,
) -> anyhow::Result<Option<String>> {
    let answer = match somebody.asks(method, method.filled(words)?, 1).await? {
        Ok(answer) => Ok(method.read(&answer)?),
        Err(status) => Err(status),
    };
    // Items of a stream are refused in the answer.
    let code = match &answer {
        Ok(text) if text.contains(&format!("\"{}\"", Said::NotPermitted.as_str())) => Code::PermissionDenied,
        Ok(_) => Code::Ok,
        Err(status) => status.code(),
    };
    let is_denied = matches!(code, Code::PermissionDenied | Code::Unauthenticated);
    let is_away = is_denied || (code == Code::NotFound && !is_listed(&NOTHING_HERE, method));
    let text = answer.as_deref().unwrap_or_default();
    let passes_over = method.rule.permission == Permission::Read || is_listed(&FILTERED, method);
    let is_list = method.rule.object == Object::List && passes_over;
    let is_right = match (somebody.refused(&method.path), is_own || *scope == Some(Scope::Site)) {
        (Some(refused), _) => code == refused,
        (None, true) => !is_away,
        (None, false) if is_list && code == Code::Ok => !shows(text, words),
        (None, false) => is_denied || code == Code::NotFound,
    };
    let is_shown = scope.as_ref().is_some_and(|scope| *scope != Scope::Site) && shows(text, others);
    let of = if is_own { "its own" } else { "another's" };
    Ok((!is_right || is_shown).then(|| format!("{} {} of {of}: {code:?} {answer:?}", somebody.name, method.path)))
}

/// Who may ask at all asks about its own and about another's: of the areas, or of robots.
async fn asked_for_all(all: &[Holder], methods: &[Method], things: &[Words; 2]) -> anyhow::Result<BTreeSet<String>> {
    let (mut wrong, mut looked) = (Vec::new(), BTreeSet::new());
    let over = |method: &&Method| !matches!(method.rule.object, Object::None | Object::Site);
    for method in methods.iter().filter(over).filter(|method| !is_listed(&NAME_NOTHING, method)) {
        // What may be looked at alone is the only thing that is ever asked of a batch.
        let [own, other] = things.clone().map(|mut words| {
            if method.name() == "SubmitTasks" {
                words.remove("validate_only");
            }
            if method.name() == "DisownAttempt" {
                words.extend([("subject", words["task_id"].clone()), ("epoch", json!(1))]);
            }
            words
        });
        let is_list = method.rule.object == Object::List && method.rule.permission == Permission::Read;
        let names_one = method.filled(&own)? != method.filled(&other)?;
        ensure!(names_one || is_list, "{} names nothing that these words know", method.path);
        for holder in all {
            let (mut own, is_robot) = (own.clone(), holder.0.name == ASKS);
            if is_robot {
                own.insert("robot_id", json!(ASKS));
            }
            for (is_own, words) in [(false, &other), (true, &own)] {
                wrong.extend(asked_about(holder, method, is_own, words, &other).await?);
            }
            // A list that is asked for everything has of the other area what the site's holder sees there, and nothing for who sees its area alone.
            if is_list && holder.0.refused(&method.path).is_none() {
                let Ok(answer) = holder.0.asks(method, Vec::new(), 2).await? else { continue };
                let text = method.read(&answer)?;
                let is_everything = holder.1 == Some(Scope::Site) && !is_listed(&NOTHING_HERE, method);
                if shows(&text, &other) != is_everything {
                    wrong.push(format!("{} {}: {text}", holder.0.name, method.path));
                }
            }
        }
        looked.insert(method.name().to_owned());
    }
    ensure!(wrong.is_empty(), "{}", wrong.join("\n"));
    Ok(looked)
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn each_role_gets_to_its_own_and_to_nothing_else_by_every_method_of_every_service() -> anyhow::Result<()> {
    let dir = folder()?;
    let samples = dir.path().join("samples");
    done(&["bundle", "samples", &samples.display().to_string(), "--config-only"])?;
    let keys = samples.join("keys").display().to_string();
    let server = Server::start_with(dir.path(), DEMO, &["--ota-keys", &keys]).await?;
    let stops = StopServer::start(dir.path(), server.address).await?;
    // First of all: nobody leaves its area.
    let engaged = [stop(stops.address, AREAS[0]).await?, stop(stops.address, AREAS[1]).await?];
    let starts = PLACES.map(|[place, ..]| place.to_owned());
    let robots = Robots::start_at(dir.path(), server.address, server.address, Some(stops.address), &starts).await?;
    done(&[
        "bundle",
        "push",
        "--server",
        &server.address.to_string(),
        &samples.join("repository").display().to_string(),
    ])?;
    let things = objects(dir.path(), &server, &robots, engaged.clone()).await?;
    let tokens = tokens(&server).await?;
    let robot = enrolled(server.address, &RobotId::parse(ASKS)?).await?.context("a robot")?;

    let methods = Method::all()?;
    ensure!(methods.len() > 70, "{}", methods.len());
    let status = methods.iter().find(|method| method.name() == "GetStatus").context("a method")?;
    for port in [server.address, stops.address] {
        let all = everybody(port, &tokens, &robot)?;
        for (somebody, _) in all.iter().filter(|(somebody, _)| somebody.refused(&status.path).is_none()) {
            until("the port knows everybody", LIMIT, async || {
                let code = somebody.asks(status, Vec::new(), 1).await?.err().map(|status| status.code());
                Ok((code != Some(Code::Unauthenticated)).then_some(()))
            })
            .await?;
        }
        let refused = asked_for_nothing(&all, &methods).await?;
        ensure!(refused > all.len() * methods.len() / 4, "hardly anybody was refused anything: {refused}");
    }
    nothing_was_done(dir.path(), &server, &engaged)?;
    let all = everybody(server.address, &tokens, &robot)?;
    let (of_stops, others): (Vec<Method>, Vec<Method>) = methods.into_iter().partition(|m| m.path.contains(".stop."));
    let looked = asked_for_all(&all, &others, &things).await?;
    say!("{} methods over objects: {looked:?}", looked.len());
    ensure!(looked.len() > 40, "{looked:?}");
    let looked = asked_for_all(&everybody(stops.address, &tokens, &robot)?, &of_stops, &things).await?;
    ensure!(looked == ["Attend", "Reset"].map(str::to_owned).into(), "{looked:?}");
    Ok(())
}

/// After calls without words nothing is in the audits that any of the callers did.
fn nothing_was_done(dir: &Path, server: &Server, engaged: &[String; 2]) -> anyhow::Result<()> {
    let output = call(&["audit", "ls", "--server", &server.address.to_string(), "-o", "json", "--limit", "1000"])?;
    let listed: Value = serde_json::from_slice(&output.stdout)?;
    let rows = listed["rows"].as_array().context("rows")?;
    let is_deed = |row: &&Value| {
        row["outcome"] == "DONE"
            && row["actor"].as_str().is_some_and(|actor| actor.starts_with("may-") || actor.ends_with(ASKS))
    };
    let deeds: Vec<_> = rows
        .iter()
        .filter(is_deed)
        .filter(|row| !["robot.enrolled", "audit.export"].contains(&row["action"].as_str().unwrap_or_default()))
        .collect();
    ensure!(rows.len() > 20 && deeds.is_empty(), "{} rows: {deeds:?}", rows.len());
    let audit = std::fs::read_to_string(dir.join("data/stop/audit.jsonl"))?;
    let acts: Vec<&str> =
        audit.lines().filter(|line| line.contains("\"ENGAGED\"") || line.contains("\"RESET\"")).collect();
    ensure!(acts.len() == engaged.len(), "{acts:?}");
    Ok(())
}
