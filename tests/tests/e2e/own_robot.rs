//! A maker's first robot: `examples/own_robot.rs` under its launcher, and its like in Python. Each joins, does a task, is stopped in the
//! middle of it, and goes on when a person has reset and resumed the stop. The one in Rust is given a new program; the one in Python is
//! killed while it stands.

use crate::harness::{Running, Server, folder, program, until};
use crate::languages::minimal_robot;
use crate::robots::enrolment;
use crate::rolled_out::{Robot, begin_rollout, call, done, trust, until_known};
use crate::room::{LIMIT, Room};
use crate::stopped::{StopServer, resume, until_held};
use anyhow::{Context, ensure};
use midshift_core::site::{CORRIDOR, DEMO, text};
use midshift_proto::task::v1::TaskState;
use std::path::Path;
use std::process::Command;

const NAME: &str = "own-1";

/// The next program of the robot, as its maker writes it down.
const BUNDLE: &str = r#"
name = "point"
version = "0.2.0"

[[component]]
name = "program"
version = "0.2.0"
kind = "process"
file = "own_robot"
hardware = ["point"]
needs = "restart"
"#;

fn own_robot() -> anyhow::Result<std::path::PathBuf> {
    program("MIDSHIFT_TEST_OWN_ROBOT", "examples/own_robot")
}

/// The robot in `home` under its launcher.
async fn launch(home: &Path, keys_and_repository: &Path, server: &Server, stops: &StopServer) -> anyhow::Result<Robot> {
    std::fs::create_dir_all(home)?;
    let (trust_file, sets) = (home.join("trust.json"), home.join("sets"));
    trust(keys_and_repository, &text::parse(DEMO)?)?.write(&trust_file)?;
    let secret = enrolment(server.address, NAME).await?.context("a site with a login")?;
    let mut command = Command::new(program("MIDSHIFT_TEST_LAUNCHER", "midshift-launcher")?);
    command.env("MIDSHIFT_ENROLL", secret).arg("--record").arg(home.join("tries")).arg("--sets").arg(&sets).arg("--");
    command.arg(own_robot()?).args(["--robot-id", NAME, "--server", &server.address.to_string()]);
    command.args(["--stop-server", &stops.address.to_string()]).arg("--data").arg(home.join("data"));
    command.arg("--sets").arg(&sets).arg("--trust").arg(&trust_file);
    Robot::start(command, home)
}

/// Builds the next program, signs it and pushes it.
fn release(dir: &Path, server: &str) -> anyhow::Result<()> {
    let (draft, built) = (dir.join("draft"), dir.join("built"));
    std::fs::create_dir_all(&draft)?;
    std::fs::write(draft.join("bundle.toml"), BUNDLE)?;
    std::fs::copy(own_robot()?, draft.join("own_robot"))?;
    let shown = |path: &Path| path.display().to_string();
    let (repository, key) = (shown(&dir.join("repository")), shown(&dir.join("keys/targets-1.pem")));
    done(&["bundle", "build", &shown(&draft), "--out", &shown(&built)])?;
    done(&["bundle", "sign", &shown(&built), "--repository", &repository, "--key", &key])?;
    done(&["bundle", "push", "--server", server, &repository])
}

async fn until_state(server: &Server, task: &str, states: &[TaskState]) -> anyhow::Result<()> {
    until(&format!("{task} {states:?}"), LIMIT, async || {
        let there = server.in_states(states).await?.unwrap_or_default();
        Ok(there.iter().any(|found| found.task_id == task).then_some(()))
    })
    .await
}

/// Stops the robot in the middle of its task; it has confirmed that it stands.
async fn stop(server: &Server, stops: &StopServer) -> anyhow::Result<String> {
    let stop_id = stops.stop(&["--robot", NAME])?;
    until_held(server.address, &[NAME.to_owned()], &format!("stop:{stop_id}")).await?;
    ensure!(server.in_states(&[TaskState::Succeeded]).await? == Some(Vec::new()), "it was not stopped in its work");
    Ok(stop_id)
}

/// A person resets the stop, which moves nobody, and resumes it.
async fn go_on(server: &Server, stops: &StopServer, stop_id: &str) -> anyhow::Result<()> {
    stops.reset(stop_id)?;
    until_held(server.address, &[NAME.to_owned()], &format!("resume:{stop_id}")).await?;
    resume(server, stop_id)
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_makers_robot_works_is_stopped_and_is_given_a_new_program_by_its_launcher() -> anyhow::Result<()> {
    let dir = folder()?;
    let shown = |name: &str| dir.path().join(name).display().to_string();
    done(&["bundle", "keygen", "--keys", &shown("keys"), "--repository", &shown("repository")])?;
    let server = Server::start_with(dir.path(), DEMO, &["--ota-keys", &shown("keys")]).await?;
    let stops = StopServer::start(dir.path(), server.address).await?;
    let (address, home) = (server.address.to_string(), dir.path().join("own"));
    let robot = launch(&home, dir.path(), &server, &stops).await?;
    until_known(&address, NAME, &home).await?;

    let task = ["task", "submit", "--server", &address, "--from", "A02", "--to", "A03", "--sku", "SKU-1"];
    done(&[&task[..], &["--task-id", "T1"]].concat())?;
    until_state(&server, "T1", &[TaskState::Running]).await?;
    let stop_id = stop(&server, &stops).await?;
    go_on(&server, &stops, &stop_id).await?;
    until_state(&server, "T1", &[TaskState::Succeeded]).await?;

    release(dir.path(), &address)?;
    let all = ["--waves", "rest", "--allow-full-push", "--soak", "0s", "--probation", "1s", "--exposure-tasks", "0"];
    done(&[&["rollout", "create", "--server", &address, "point-0.2.0"][..], &all].concat())?;
    begin_rollout(&address, "point-0.2.0")?;
    let waited = call(&["rollout", "wait", "--server", &address, "point-0.2.0", "--timeout", "120s"])?;
    assert_eq!(waited.status.code(), Some(0), "{}", String::from_utf8_lossy(&waited.stderr));
    robot.keeps("0.2.0").await?;
    // What runs now is the program of the bundle, from where the one before stood.
    done(&[&task[..], &["--task-id", "T2"]].concat())?;
    until_state(&server, "T2", &[TaskState::Succeeded]).await
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_makers_robot_in_python_works_is_stopped_killed_and_goes_on_by_a_persons_word() -> anyhow::Result<()> {
    let room = Room::open_on(&CORRIDOR.replace("speed_limit_mm_s = 1500", "speed_limit_mm_s = 5000")).await?;
    let (dir, server) = (room.dir.path(), &room.server);
    let stops = StopServer::start(dir, server.address).await?;
    let mut command = minimal_robot(NAME, server.address, Some(stops.address), dir).await?;
    let mut robot = Running::start(&mut command, &dir.join("robot.log"))?;
    room.until_held("park-a", NAME, true).await?;
    let effects = || std::fs::read_to_string(dir.join("effects")).unwrap_or_default();
    room.submit("T1", NAME).await?;
    until("it has picked", LIMIT, async || Ok((effects() == "pick T1 1 found\n").then_some(()))).await?;
    let stop_id = stop(server, &stops).await?;
    // It stands by its memory too.
    robot.kill()?;
    robot = Running::start(&mut command, &dir.join("robot.log"))?;
    go_on(server, &stops, &stop_id).await?;
    room.until_state("T1", TaskState::Succeeded).await?;
    assert_eq!(effects(), "pick T1 1 found\nplace T1 3 found\n");
    ensure!(!robot.has_ended()?, "{}", std::fs::read_to_string(dir.join("robot.log"))?);
    Ok(())
}
