//! The command line as programs see it: `-o json`, exit codes and messages, word for word in a golden transcript.
//!
//! What differs from run to run (times, etags, positions in a log) stands there as its kind. Of a stream the first documents stand there.

use crate::engine::fresh_store;
use crate::harness::{Running, channel, free_port, midshift, sign_in, sign_in_second, sign_in_to, until};
use crate::room::{LIMIT, Room};
use crate::secrets::heard;
use anyhow::Context;
use midshift_proto::ota::v1::bundle_service_client::BundleServiceClient;
use midshift_proto::ota::v1::rollout_service_client::RolloutServiceClient;
use midshift_proto::ota::v1::{ListBundlesRequest, ListRobotSoftwareRequest, ListRolloutRobotsRequest, RolloutStep};
use midshift_proto::sim::v1::GetWorldRequest;
use midshift_proto::sim::v1::sim_service_client::SimServiceClient;
use midshift_proto::task::v1::TaskState;
use serde_json::{Deserializer, Value};
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};

/// Keys whose values no program may read anything into.
const OPAQUE: [&str; 13] = [
    "age",
    "workGeneration",
    "number",
    "seq",
    "etag",
    "cursor",
    "nextPageToken",
    "sessionEpoch",
    "generation",
    "grantId",
    "hb",
    "appliedWork",
    "appliedPolicy",
];
/// Keys of measurements.
const MEASURED: [&str; 7] =
    ["heartbeat", "energyMwh", "hottestJointDecidegrees", "durationMs", "attachedMs", "pathMm", "loadedPathMm"];
/// Nobody listens there.
const NOBODY: &str = "127.0.0.1:1";
/// Keys that are there once so many heartbeats have come.
const LATE: [&str; 2] = ["clockErrorMs", "clockOffsetMs"];

/// The two forms of the source article as they stand, one a line.
const LIST: &str = r#"{"task_id":"TASK-3","robot_id":"","type":"transport","priority":3,"content":{"from_waypoint":"A","to_waypoint":"B","item_sku":"SKU-3"},"timeout_seconds":300,"retry_strategy":{"max_retry_times":2,"retry_interval_seconds":10},"created_at":"2026-11-20T08:00:00Z"}
{"task_id":"TASK-4","robot_id":"r1","task_type":"transport","priority":3,"from_waypoint":"A","to_waypoint":"B","item_sku":"SKU-4","timeout_seconds":300,"max_retry_times":2,"retry_interval_seconds":10,"created_at":"2026-11-20T08:00:00Z"}
"#;
/// Good and bad lines of a table.
const TABLE: &str = "task_type,from_waypoint,to_waypoint,timeout_seconds\ntransport,A,B,300\ntransport,A,B,soon\n";

/// A release, and one that breaks rules.
const RELEASE: &str = "name = \"walk\"\nversion = \"1.5.0\"\n[[component]]\nname = \"gait\"\nversion = \"1.5.0\"\nkind = \"process\"\nfile = \"gait\"\nhardware = [\"h1\", \"midshift-sim\"]\nneeds = \"restart\"\n";
const BAD_RELEASE: &str = "name = \"Walk\"\nversion = \"1.5\"\n[[component]]\nname = \"gait\"\nversion = \"1.5.0\"\nkind = \"base\"\nfile = \"gait\"\nhardware = []\nneeds = \"park\"\n";

/// Two mistakes of a type, and a good one.
const BAD_TYPE: &str = "name = \"Look\"\ndescription = \"Looks at a shelf.\"\nfields = [{ name = \"shelf\", description = \"Which shelf.\", waypoint = {} }]\nsteps = [{ goto = { field = \"shlef\" } }]\n";
const TYPE: &str = "name = \"shelf-look\"\ndescription = \"Looks at a shelf.\"\ntimeout = \"60s\"\nfields = [{ name = \"shelf\", description = \"Which shelf.\", waypoint = {} }, { name = \"height_mm\", description = \"Where it looks.\", integer = { least = 0, most = 2000, unit = \"mm\" }, default = 900 }]\nsteps = [{ goto = { field = \"shelf\" } }, { action = { name = \"inspect\", params = { height_mm = \"height_mm\" } } }]\n";

/// Task types: registered, used, deleted.
fn types_of_tasks(t: &mut Transcript) -> anyhow::Result<()> {
    std::fs::write(t.dir.join("bad-type.toml"), BAD_TYPE)?;
    std::fs::write(t.dir.join("type.toml"), TYPE)?;
    t.note(&["task", "type", "put", "bad-type.toml"])?;
    t.note(&["task", "type", "put", "type.toml", "--dry-run"])?;
    t.note(&["task", "type", "put", "type.toml", "-o", "json"])?;
    t.note(&["task", "type", "ls"])?;
    t.note(&["task", "type", "get", "shelf-look"])?;
    t.note(&["task", "type", "get", "shelf-lok"])?;
    let submit = ["task", "submit", "--type", "shelf-look", "--dry-run"];
    t.note(&[&submit[..], &["--field", "shelf=B", "--field", "height_mm=1200", "-o", "json"]].concat())?;
    t.note(&[&submit[..], &["--field", "shlef=B", "--field", "height_mm=9000"]].concat())?;
    t.note(&["task", "submit", "--type", "shelf-lok", "--dry-run"])?;
    t.note(&["task", "type", "accept", "known"])?;
    t.note(&["task", "type", "accept", "any"])?;
    t.note(&["task", "type", "delete", "shelf-look"])?;
    t.note(&["task", "type", "delete", "shelf-lok"])?;
    Ok(())
}

fn bundles(dir: &Path) -> anyhow::Result<()> {
    for (name, text) in [("walk", RELEASE), ("bad", BAD_RELEASE)] {
        let folder = dir.join(name);
        std::fs::create_dir(&folder)?;
        std::fs::write(folder.join("bundle.toml"), text)?;
        std::fs::write(folder.join("gait"), "walks")?;
    }
    Ok(())
}

struct Transcript {
    program: PathBuf,
    dir: PathBuf,
    server: String,
    /// Asked by somebody else, who may approve what the first one wrote.
    is_second: bool,
    text: String,
}

impl Transcript {
    /// With a limit of open files that every machine has, since `doctor` looks at it.
    fn command(&self, arguments: &[&str]) -> Command {
        let mut command = Command::new("sh");
        command.args(["-c", "ulimit -n 1024 && exec \"$0\" \"$@\""]).arg(&self.program).args(arguments);
        command.env("MIDSHIFT_SERVER", &self.server).env_remove("NO_COLOR").current_dir(&self.dir);
        if let Ok(address) = self.server.parse() {
            let sign_in = if self.is_second { sign_in_second } else { sign_in };
            sign_in(&mut command, address);
        }
        command
    }

    fn run(&self, arguments: &[&str]) -> anyhow::Result<Output> {
        heard(&mut self.command(arguments))
    }

    /// Runs a command and writes down what it printed and how it ended; its standard output.
    fn note(&mut self, arguments: &[&str]) -> anyhow::Result<Value> {
        let output = self.run(arguments)?;
        let said = hidden(&String::from_utf8(output.stderr)?.replace(&self.server, "<server>"));
        let out = String::from_utf8(output.stdout)?.replace(&self.server, "<server>");
        assert!(!said.contains('\u{1b}') && !out.contains('\u{1b}'), "{arguments:?}: colours in a pipe");
        let code = output.status.code().context("it was killed")?;
        self.asked(arguments);
        let value: Value = serde_json::from_str(&out).unwrap_or(Value::Null);
        match &value {
            Value::Null => self.text += &timeless(&out),
            value => self.document(value)?,
        }
        self.text += &said;
        self.text += &format!("exit {code}\n\n");
        Ok(value)
    }

    /// Runs a command that would go on for ever and writes down the first documents that it prints.
    fn note_stream(&mut self, arguments: &[&str], documents: usize) -> anyhow::Result<()> {
        let mut child = self.command(arguments).stdout(Stdio::piped()).stderr(Stdio::null()).spawn()?;
        let printed = child.stdout.take().context("a pipe")?;
        self.asked(arguments);
        let values: Result<Vec<Value>, _> = Deserializer::from_reader(printed).into_iter().take(documents).collect();
        child.kill()?;
        child.wait()?;
        let values = values?;
        assert_eq!(values.len(), documents, "{arguments:?} ended");
        values.iter().try_for_each(|value| self.document(value))?;
        self.text += "goes on\n\n";
        Ok(())
    }

    fn asked(&mut self, arguments: &[&str]) {
        let line = arguments.join(" ").replace(&self.server, "<server>");
        self.text += &format!("$ midshift {}\n", hidden(&line));
    }

    fn document(&mut self, value: &Value) -> anyhow::Result<()> {
        self.text += &format!("{}\n", serde_json::to_string_pretty(&plain("", value))?);
        Ok(())
    }
}

/// The same text without times and without the values of flags that nobody may read anything into.
fn hidden(text: &str) -> String {
    let mut plain = timeless(text);
    for flag in ["--if-match ", "--page-token ", "  etag: "] {
        if let Some(at) = plain.find(flag).map(|at| at + flag.len()) {
            let end = plain[at..].find(char::is_whitespace).map_or(plain.len(), |n| at + n);
            plain.replace_range(at..end, "<opaque>");
        }
    }
    plain
}

/// The same text with each moment of RFC 3339 in milliseconds, all of which are as long, replaced by its kind.
fn timeless(text: &str) -> String {
    const LENGTH: usize = "2026-01-01T00:00:00.000Z".len();
    let (mut plain, mut rest) = (String::new(), text);
    while let Some(first) = rest.chars().next() {
        let moment =
            rest.get(..LENGTH).filter(|m| is_time(m) && m.bytes().all(|b| b.is_ascii_digit() || b"-:.TZ".contains(&b)));
        plain += moment.map_or(first.to_string().as_str(), |_| "<time>");
        rest = &rest[moment.map_or(first.len_utf8(), str::len)..];
    }
    plain
}

fn is_time(text: &str) -> bool {
    text.len() >= 20 && text.ends_with('Z') && text.as_bytes().get(10) == Some(&b'T')
}

/// The same document with what is different in every run replaced by its kind.
fn plain(key: &str, value: &Value) -> Value {
    match value {
        Value::Object(fields) => {
            let kept = fields.iter().filter(|(k, _)| !LATE.contains(&k.as_str()));
            kept.map(|(k, v)| (k.clone(), plain(k, v))).collect::<serde_json::Map<_, _>>().into()
        }
        Value::Array(items) => items.iter().map(|v| plain(key, v)).collect(),
        _ if OPAQUE.contains(&key) => "<opaque>".into(),
        _ if MEASURED.contains(&key) => "<measured>".into(),
        Value::String(text) if is_time(text) => "<time>".into(),
        Value::String(text) => timeless(text).into(),
        other => other.clone(),
    }
}

fn golden() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("golden/cli.txt")
}

/// A free place, and one under a robot.
fn clear(t: &mut Transcript, places: &Value) -> anyhow::Result<()> {
    for place in ["corridor", "park-a"] {
        let of = places["places"].as_array().and_then(|all| all.iter().find(|p| p["placeId"] == place));
        let etag = of.and_then(|p| p["etag"].as_str()).with_context(|| format!("no etag of {place}"))?;
        let asked = ["zone", "clear", place, "--reason", "looked inside", "--if-match", etag, "-o", "json"];
        t.note(&asked)?;
    }
    Ok(())
}

/// What people call a robot, and which machine it is.
fn named(t: &mut Transcript) -> anyhow::Result<()> {
    t.note(&["robot", "label", "r1", "floor=2", "line=a", "-o", "json"])?;
    t.note(&["robot", "label", "r1", "floor=3"])?;
    t.note(&["robot", "label", "r1", "floor=2", "floor-"])?;
    t.note(&["robot", "label", "r1", "floor"])?;
    t.note(&["robot", "label", "r9", "floor=2"])?;
    t.note(&["robot", "label", "r1", "floor-", "line-"])?;
    t.note(&["robot", "adopt", "r1"])?;
    t.note(&["robot", "adopt", "r1", "--key", "r1"])?;
    t.note(&["robot", "adopt", "r1", "--key", &"0a".repeat(32)])?;
    Ok(())
}

/// What a person sees: columns, and what to do next.
fn for_people(t: &mut Transcript) -> anyhow::Result<()> {
    t.note(&["robot", "cordon", "r1", "--reason", "a wheel squeaks"])?;
    t.note(&["task", "submit", "--from", "A", "--to", "B", "--sku", "SKU-5", "--task-id", "TASK-5"])?;
    t.note(&["task", "submit", "--from", "A", "--to", "B", "--dry-run"])?;
    t.note(&["task", "ls", "--limit", "1"])?;
    t.note(&["task", "edit", "TASK-5", "--priority", "2", "--reason", "the lorry waits"])?;
    t.note(&["task", "edit", "TASK-5", "--robot", "r9", "--reason", "it is free"])?;
    t.note(&["task", "hold", "TASK-5", "--reason", "the aisle is wet"])?;
    t.note(&["task", "explain", "TASK-5"])?;
    t.note(&["task", "release", "TASK-5", "--reason", "it is dry"])?;
    t.note(&["task", "get", "TASK-5"])?;
    t.note(&["task", "resume", "--robot", "r1", "--reason", "all clear"])?;
    t.note(&["task", "cancel", "TASK-5", "--reason", "not wanted", "-o", "name"])?;
    Ok(())
}

/// Software on a server without keys, and on one that has them.
async fn releases(room: &Room, t: &mut Transcript) -> anyhow::Result<()> {
    t.note(&["bundle", "ls"])?;
    t.note(&["rollout", "ls"])?;
    let address = free_port()?;
    let mut command = Command::new(&t.program);
    command.env("MIDSHIFT_NO_STOP", "true");
    command.args(["serve", "--data", "served", "--ota-keys", "keys", "--listen", &address.to_string()]);
    command.args(["--site", "site.toml", "--first-token-file", "served-token"]).args(fresh_store()?);
    let _serve = Running::start(command.current_dir(&t.dir), &t.dir.join("serve.log"))?;
    sign_in_to(address, t.dir.join("served/identity/ca.pem"), &t.dir.join("served-token")).await?;
    until("the server of software", LIMIT, || async {
        let mut client = BundleServiceClient::new(channel(address)?);
        Ok(client.list_bundles(ListBundlesRequest::default()).await.ok().map(|_| ()))
    })
    .await?;
    let before = std::mem::replace(&mut t.server, address.to_string());
    t.note(&["bundle", "ls", "-o", "json"])?;
    t.note(&["bundle", "push", "repository", "-o", "json"])?;
    t.note(&["bundle", "push", "repository"])?;
    t.note(&["bundle", "ls", "-o", "json"])?;
    t.note(&["bundle", "ls", "-o", "name"])?;
    rollouts(room, t, address).await?;
    t.note(&["bundle", "keygen", "--keys", "other-keys", "--repository", "other", "-o", "json"])?;
    t.note(&["bundle", "push", "other"])?;
    t.note(&[
        "bundle",
        "sign",
        "walk-1.5.0",
        "--repository",
        "other",
        "--key",
        "other-keys/targets-1.pem",
        "-o",
        "json",
    ])?;
    t.note(&["bundle", "push", "other"])?;
    t.server = before;
    Ok(())
}

/// Roll-outs of the pushed bundle over one robot whose agent takes no software.
async fn rollouts(room: &Room, t: &mut Transcript, address: SocketAddr) -> anyhow::Result<()> {
    let create = ["rollout", "create", "walk-1.5.0", "--waves", "1,25%,rest", "--soak", "10s"];
    let said = ["--reason", "looked at it"];
    t.note(&["rollout", "ls"])?;
    t.note(&[&create[..], &["--dry-run"]].concat())?;
    let _robot = room.robot("r2", "park-b", address, &[]).await?;
    let client = RolloutServiceClient::new(channel(address)?);
    until("a robot whose software is known", LIMIT, || async {
        let software = client.clone().list_robot_software(ListRobotSoftwareRequest::default()).await?.into_inner();
        Ok((!software.software.is_empty()).then_some(()))
    })
    .await?;

    // What it would do, and what is refused.
    t.note(&[&create[..], &["--dry-run"]].concat())?;
    t.note(&[&create[..], &["--dry-run", "-o", "json"]].concat())?;
    t.note(&[&create[..], &["--model", "h9", "--dry-run"]].concat())?;
    t.note(&["rollout", "create", "walk-9", "--dry-run"])?;
    t.note(&["rollout", "create", "walk-1.5.0", "--waves", "101%,rest,0", "--probation", "10ms", "--dry-run"])?;
    t.note(&["rollout", "create", "walk-1.5.0", "--waves", "1,many", "--dry-run"])?;
    let pin = ["robot", "pin", "r2", "--request-id", "pin-1", "--reason"];
    t.note(&[&pin[..], &["it is being measured", "--dry-run"]].concat())?;
    t.note(&[&pin[..], &["it is being measured"]].concat())?;
    t.note(&[&pin[..], &["it is being mended"]].concat())?;
    t.note(&["robot", "pin", "r9", "--reason", "it is being measured"])?;
    t.note(&[&create[..], &["--dry-run"]].concat())?;
    t.note(&["robot", "unpin", "r2", "-o", "json"])?;
    t.note(&["robot", "unstick", "r2", "--reason", "I freed its disk"])?;
    t.note(&["robot", "unstick", "r9", "--reason", "I freed its disk"])?;
    t.note(&["robot", "replace", "r2", "--accept-key"])?;

    // Written down.
    t.note(&create)?;
    t.note(&[&create[..], &["--max-in-flight", "2"]].concat())?;
    t.note(&["rollout", "ls"])?;
    t.note(&["rollout", "get", "walk-1.5.0"])?;
    t.note(&["rollout", "get", "walk-9"])?;
    t.note(&["rollout", "explain", "walk-1.5.0", "r2"])?;
    t.note(&["rollout", "start", "walk-1.5.0"])?;
    t.note(&["rollout", "wait", "walk-1.5.0", "--timeout", "10ms"])?;

    // Approved by another than its author, and begun.
    let approve = ["rollout", "approve", "walk-1.5.0", "--reason", "tried at home"];
    t.note(&[&create[..], &["--start"]].concat())?;
    t.note(&["rollout", "submit", "walk-1.5.0"])?;
    t.note(&approve)?;
    t.is_second = true;
    t.note(&approve)?;
    t.is_second = false;
    t.note(&["rollout", "start", "walk-1.5.0"])?;
    until("the robot fetches", LIMIT, || async {
        let request = ListRolloutRobotsRequest { rollout_id: "walk-1.5.0".to_owned(), ..Default::default() };
        let robots = client.clone().list_rollout_robots(request).await?.into_inner().robots;
        Ok(robots.iter().any(|r| r.step() == RolloutStep::Staging).then_some(()))
    })
    .await?;
    t.note(&[&["rollout", "pause", "walk-1.5.0"][..], &said].concat())?;
    t.note(&["rollout", "ls", "-o", "json"])?;
    t.note(&["rollout", "get", "walk-1.5.0"])?;
    t.note(&["rollout", "robots", "walk-1.5.0", "-o", "json"])?;
    t.note(&["rollout", "get", "walk-1.5.0", "--robots", "-o", "json"])?;
    t.note(&["rollout", "explain", "walk-1.5.0", "r2"])?;
    t.note(&["rollout", "explain", "walk-1.5.0", "r9"])?;
    t.note(&["rollout", "explain", "walk-1.5.0"])?;
    t.note_stream(&["rollout", "watch", "walk-1.5.0", "-o", "json"], 1)?;
    t.note(&[&["rollout", "resume", "walk-1.5.0", "-o", "name"][..], &said].concat())?;
    t.note(&[&["rollout", "promote", "walk-1.5.0"][..], &said].concat())?;
    t.note(&["rollout", "retry", "walk-1.5.0"])?;
    t.note(&["robot", "exclude", "r9", "--from", "walk-1.5.0"])?;

    // Ended.
    t.note(&[&["rollout", "abort", "walk-1.5.0", "--if-match", "1"][..], &said].concat())?;
    t.note(&[&["rollout", "abort", "walk-1.5.0", "-o", "name"][..], &said].concat())?;
    t.note(&["rollout", "wait", "walk-1.5.0", "--for", "ended"])?;
    t.note(&["rollout", "watch", "walk-1.5.0"])?;
    t.note(&["rollout", "history", "walk-1.5.0", "-o", "json"])?;
    t.note(&["rollout", "report", "walk-1.5.0", "-o", "json"])?;
    t.note(&["rollout", "report", "walk-1.5.0", "-o", "html"])?;
    t.note(&["rollout", "ls", "-o", "html"])?;
    t.note(&["rollout", "rollback", "walk-1.5.0", "--as", "back"])?;
    t.note(&["quarantine", "ls"])?;
    t.note(&["quarantine", "ls", "-o", "json"])?;
    t.note(&["quarantine", "lift", "r2", "walk-1.5.0", "--dry-run"])?;
    t.note(&["bundle", "revoke", "walk-1.5.0", "--reason", "it limps", "--dry-run"])?;
    t.note(&["bundle", "revoke", "walk-1.5.0", "--reason", "it limps"])?;
    t.note(&["rollout", "create", "again", "--bundle", "walk-1.5.0"])?;
    t.note(&["robot", "retire", "r2", "--reason", "sold", "-o", "name"])?;
    t.note(&["doctor", "--stop-server", NOBODY, "-o", "json"])?;
    Ok(())
}

/// Faults of simulated robots, which only their own process takes.
async fn faults(t: &mut Transcript) -> anyhow::Result<()> {
    let address = free_port()?;
    let mut command = Command::new(&t.program);
    command.args(["dev", "--robots", "2", "--seed", "7", "--keep-open", "0", "--listen", &address.to_string()]);
    let _dev = Running::start(&mut command, &t.dir.join("dev.log"))?;
    until("the simulator's first answer", LIMIT, || async {
        let world = SimServiceClient::new(channel(address)?).get_world(GetWorldRequest::default()).await;
        Ok(world.ok().map(|_| ()))
    })
    .await?;
    let server = std::mem::replace(&mut t.server, address.to_string());
    t.note(&["sim", "fault", "rbt-01", "--obstacle", "5s", "-o", "json"])?;
    t.note(&["sim", "fault", "rbt-01", "--obstacle", "5s"])?;
    t.note(&["sim", "fault", "rbt-99", "--jam", "-o", "json"])?;
    t.note(&["sim", "fault", "rbt-01"])?;
    t.note(&["sim", "world", "-o", "json"])?;
    t.server = server;
    Ok(())
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn golden_transcript_of_the_command_line() -> anyhow::Result<()> {
    let room = Room::open().await?;
    let mut t = Transcript {
        program: midshift()?,
        dir: room.dir.path().to_owned(),
        server: room.server.address.to_string(),
        is_second: false,
        text: String::new(),
    };
    let robot = room.robot("r1", "park-a", room.server.address, &[]).await?;
    room.until_held("park-a", "r1", true).await?;
    room.until_it_obeys("r1").await?;

    // Robots, places, areas.
    t.note(&["robot", "ls", "-o", "json"])?;
    t.note(&["robot", "get", "r1", "-o", "json"])?;
    t.note(&["robot", "explain", "r1", "-o", "json"])?;
    t.note(&["robot", "get", "r9", "-o", "json"])?;
    t.note(&["robot", "cordon", "r1", "--reason", "a wheel squeaks", "-o", "json"])?;
    t.note(&["robot", "ls", "-o", "name"])?;
    named(&mut t)?;
    let places = t.note(&["zone", "ls", "-o", "json"])?;
    clear(&mut t, &places)?;
    t.note_stream(&["robot", "watch", "r1", "-o", "json"], 1)?;
    t.note(&["area", "get", "rooms", "-o", "json"])?;
    t.note(&["area", "put", "rooms", "--speed-limit", "1000", "-o", "json"])?;
    t.note(&["area", "put", "rooms", "--speed-limit", "0", "-o", "json"])?;
    let window = "mon-fri 22:00-05:00 Europe/Berlin";
    t.note(&[
        "area",
        "put",
        "rooms",
        "--off-work",
        "20",
        "--keep-in-work",
        "pick=3",
        "--window",
        window,
        "-o",
        "json",
    ])?;
    t.note(&["area", "put", "rooms", "--off-work", "101", "--window", "daily 01:00-04:00 Berlin", "-o", "json"])?;
    t.note(&["area", "put", "rooms", "--keep-in-work", "pick=0", "--window", "always", "--frozen", "true"])?;
    t.note(&["area", "put", "rooms", "--frozen", "false", "--window", window])?;
    let charging = ["--charge-below", "25", "--charge-callable-above", "40", "--charge-idle-below", "70"];
    t.note(&[&["area", "put", "rooms", "--charge-to", "85", "-o", "json"][..], &charging].concat())?;
    t.note(&["planner", "get"])?;
    t.note(&["planner", "put", "--horizon", "20s", "--ageing", "0", "-o", "json"])?;
    t.note(&["planner", "put", "--horizon", "2m", "--urgent-weight", "0"])?;
    t.note(&["planner", "put", "--policy", "fifo-nearest", "--dry-run", "-o", "name"])?;
    t.note(&["planner", "plans"])?;
    t.note(&["planner", "plan", "7"])?;
    t.note(&["planner", "replay", "no-such-plan.json"])?;

    // Tasks, while the robot is out of dispatch.
    let submit = ["task", "submit", "--from", "A", "--to", "B", "--sku", "SKU-1", "--task-id", "TASK-1"];
    t.note(&[&submit[..], &["--dry-run", "-o", "json"]].concat())?;
    t.note(&[&submit[..], &["--request-id", "req-1", "-o", "json"]].concat())?;
    t.note(&[&submit[..], &["--request-id", "req-1", "-o", "name"]].concat())?;
    t.note(&[
        "task",
        "submit",
        "--from",
        "nowhere",
        "--to",
        "B",
        "--priority",
        "12",
        "--request-id",
        "req-1",
        "-o",
        "json",
    ])?;
    t.note(&[
        "task",
        "submit",
        "--from",
        "A",
        "--to",
        "park-b",
        "--task-id",
        "TASK-1",
        "--request-id",
        "req-2",
        "-o",
        "json",
    ])?;
    t.note(&["task", "submit", "--from", "A", "--to", "B", "--task-id", "TASK-2", "-o", "name"])?;
    t.note(&["task", "ls", "-o", "json"])?;
    t.note(&["task", "ls", "-o", "name"])?;
    t.note(&["task", "get", "TASK-1", "-o", "json"])?;
    t.note(&["task", "get", "TASK-9", "-o", "json"])?;
    t.note(&["task", "explain", "TASK-1", "-o", "json"])?;
    t.note(&["task", "cancel", "TASK-2", "--reason", "not wanted", "-o", "json"])?;
    t.note(&["task", "wait", "TASK-2", "-o", "json"])?;
    t.note_stream(&["task", "watch", "TASK-2", "-o", "json"], 2)?;
    t.note(&["task", "resolve", "TASK-1", "--as", "succeeded", "--reason", "by hand", "-o", "json"])?;
    t.note(&["task", "resume", "--robot", "r1", "--reason", "all clear", "-o", "json"])?;
    t.note(&["task", "resume", "--robot", "r1"])?;
    for_people(&mut t)?;
    types_of_tasks(&mut t)?;

    // Lists.
    std::fs::write(t.dir.join("list.jsonl"), LIST)?;
    std::fs::write(t.dir.join("table.csv"), TABLE)?;
    t.note(&["task", "submit", "--file", "list.jsonl", "--request-id", "list", "-o", "json"])?;
    t.note(&["task", "submit", "--file", "table.csv", "-o", "json"])?;
    t.note(&["task", "get", "TASK-3", "-o", "json"])?;
    t.note(&["task", "get", "TASK-4", "-o", "json"])?;
    for task in ["TASK-3", "TASK-4"] {
        t.note(&["task", "cancel", task, "--reason", "not wanted", "-o", "name"])?;
    }

    // Done.
    t.note(&["robot", "uncordon", "r1", "-o", "json"])?;
    room.until_state("TASK-1", TaskState::Succeeded).await?;
    until("the robot stands", LIMIT, || async { Ok(robot.body.lock().idle_since().map(|_| ())) }).await?;
    t.note(&["task", "wait", "TASK-1", "-o", "json"])?;

    // Maintenance, and what a person should look into.
    t.note(&["robot", "drain", "r1", "--reason", "new wheels", "--within", "10s", "-o", "name"])?;
    t.note(&["robot", "drain", "r1", "--reason", "new wheels"])?;
    t.note(&["robot", "undrain", "r1", "-o", "name"])?;
    t.note(&["incident", "ls", "-o", "json"])?;
    t.note(&["incident", "ls"])?;
    t.note(&["incident", "close", "nothing", "--reason", "I looked"])?;

    t.note(&["zone", "ls", "-o", "name"])?;
    t.note(&["doctor", "--stop-server", NOBODY, "-o", "json"])?;
    t.note(&["doctor", "--stop-server", NOBODY])?;
    t.note(&["sim", "world", "-o", "json"])?;
    t.note(&["health"])?;
    t.note(&["health", "--ready", "-o", "json"])?;
    t.note(&["health", "--service", "midshift.fleet.v1.FleetService"])?;
    t.note(&["health", "--service", "midshift.stop.v1.StopService"])?;
    faults(&mut t).await?;

    // Without a server.
    t.note(&["map", "lint", "site.toml", "-o", "json"])?;
    t.note(&["map", "show", "site.toml", "-o", "json"])?;
    t.note(&["map", "show", "site.toml"])?;
    t.note(&["migrate", "--data", "elsewhere"])?;
    t.note(&["migrate", "--data", "elsewhere", "-o", "json"])?;
    bundles(&t.dir)?;
    t.note(&[
        "bundle",
        "keygen",
        "--profile",
        "release",
        "--keys",
        "keys",
        "--repository",
        "repository",
        "-o",
        "json",
    ])?;
    t.note(&["bundle", "build", "walk", "--out", "walk-1.5.0", "-o", "json"])?;
    t.note(&["bundle", "build", "walk", "--out", "walk-1.5.0"])?;
    t.note(&["bundle", "build", "bad", "--out", "bad-1"])?;
    t.note(&["bundle", "inspect", "walk-1.5.0"])?;
    let repository = ["--repository", "repository", "-o", "json", "--key"];
    t.note(&[&["bundle", "sign", "walk-1.5.0"][..], &repository, &["keys/targets-1.pem"]].concat())?;
    t.note(&[&["bundle", "sign", "--pending"][..], &repository, &["keys/targets-2.pem"]].concat())?;
    t.note(&["bundle", "verify", "repository", "-o", "json"])?;
    t.note(&["bundle", "samples", "samples", "--config-only", "-o", "json"])?;
    t.note(&["bundle", "samples", "samples", "--config-only"])?;
    releases(&room, &mut t).await?;
    std::fs::write(t.dir.join("walk-1.5.0/gait-1.5.0.component"), "flies")?;
    t.note(&["bundle", "inspect", "walk-1.5.0"])?;
    t.note(&["bundle", "verify", "nowhere"])?;
    t.note(&["explain-error", "STALE_AUTHORITY", "-o", "json"])?;
    t.note(&["explain-error", "NO_SUCH_CODE"])?;
    t.note(&["task", "submit", "--from", "A"])?;
    let nobody = free_port()?.to_string();
    t.server = nobody;
    t.note(&["robot", "ls", "-o", "json"])?;
    t.note(&["health"])?;
    t.note(&["health", "--ready"])?;

    if std::env::var_os("BLESS").is_some() {
        std::fs::create_dir_all(golden().parent().context("a folder")?)?;
        std::fs::write(golden(), &t.text)?;
    }
    let expected = std::fs::read_to_string(golden()).unwrap_or_default();
    for (n, (was, is)) in expected.lines().zip(t.text.lines()).enumerate() {
        assert_eq!(is, was, "line {} of tests/golden/cli.txt; `cargo xtask golden` if the change is meant", n + 1);
    }
    assert_eq!(t.text.lines().count(), expected.lines().count(), "`cargo xtask golden` if the change is meant");
    Ok(())
}
