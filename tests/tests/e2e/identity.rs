//! Who is who with real programs over TLS: a copied key, a revoked robot, a secret that is used twice, and a token that reaches too far.

use crate::harness::{Running, Server, channel, folder, midshift, sign_in, until};
use crate::kill::{all_over, at_work, judge, submit};
use crate::robots::{Robots, enrolment, with_robots};
use crate::rolled_out::{call, done};
use crate::secrets::{heard, keep_secret, secret_part};
use crate::stack::{Stack, machines_of};
use crate::stopped::StopServer;
use crate::unheard::obeyed;
use anyhow::{Context, bail, ensure};
use midshift_agent::dial::{Dial, TcpDial};
use midshift_agent::enrolment::Enrolled;
use midshift_agent::tls::Tls;
use midshift_core::reason::Code;
use midshift_core::robot::StopLevel;
use midshift_core::site::{CORRIDOR, DEMO, Site, text};
use midshift_proto::identity::v1::CreateEnrolmentRequest;
use midshift_proto::identity::v1::identity_service_client::IdentityServiceClient;
use midshift_proto::stop::v1::GetStatusRequest;
use midshift_proto::stop::v1::stop_service_client::StopServiceClient;
use midshift_proto::telemetry::v1::GetRobotRequest;
use midshift_proto::telemetry::v1::telemetry_service_client::TelemetryServiceClient;
use midshift_sim::journal::{self, Effect};
use serde_json::Value;
use std::collections::BTreeSet;
use std::net::SocketAddr;
use std::os::unix::process::CommandExt;
use std::path::Path;
use std::process::{Command, Output};
use std::time::Duration;

const ROBOTS: usize = 6;
const TASKS: usize = 30;
const LIMIT: Duration = Duration::from_secs(60);

/// What the command line prints as JSON.
pub fn json(server: SocketAddr, arguments: &[&str]) -> anyhow::Result<Value> {
    let address = server.to_string();
    let output = call(&[arguments, &["-o", "json", "--server", &address]].concat())?;
    ensure!(output.status.success(), "{arguments:?}: {}", String::from_utf8_lossy(&output.stderr));
    Ok(serde_json::from_slice(&output.stdout)?)
}

pub fn incidents(server: SocketAddr) -> anyhow::Result<Vec<Value>> {
    let listed = json(server, &["incident", "ls", "--all"])?;
    Ok(listed["incidents"].as_array().cloned().unwrap_or_default())
}

/// Whether a second machine is attached with the robot's name, and whether the robot itself was heard a moment ago.
pub async fn presence(server: SocketAddr, robot_id: &str) -> anyhow::Result<(bool, bool)> {
    let request = GetRobotRequest { robot_id: robot_id.to_owned() };
    let robot = TelemetryServiceClient::new(channel(server)?).get_robot(request).await?.into_inner().robot;
    let robot = robot.context("a robot")?;
    let is_heard = robot.age.is_some_and(|age| age.seconds < 3);
    Ok((robot.observed, is_heard))
}

/// Serial number of the certificate in a machine's folder, by the server that took it.
fn serial(folder: &Path) -> anyhow::Result<String> {
    use rustls::pki_types::pem::PemObject;
    let enrolled = Enrolled::read(folder)?.context("it is enrolled")?;
    let leaf = rustls::pki_types::CertificateDer::from_pem_slice(enrolled.certificate_pem.as_bytes())?;
    Ok(midshift_edge::serial_of(&leaf).context("a serial number")?.to_string())
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_copied_key_is_observed_with_an_incident_while_the_original_works_and_a_revoked_robot_is_cut()
-> anyhow::Result<()> {
    let dir = folder()?;
    let site: Site = with_robots(DEMO, ROBOTS)?;
    let server = Server::start_for(dir.path(), &site).await?;
    let address = server.address;
    let stops = StopServer::start(dir.path(), address).await?;
    let robots = Robots::start_beside(dir.path(), address, address, Some(stops.address), &site).await?;
    submit(address, &site, 7, TASKS).await?;
    at_work(address, 4, &BTreeSet::new()).await?;

    let elsewhere = dir.path().join("copy");
    let mut copy = robots.copy("rbt-01", &elsewhere)?;
    let journal = elsewhere.join("journal.jsonl");
    let before = journal::read(&journal)?.len();
    until("the second machine is seen", LIMIT, async || {
        let (observed, is_heard) = presence(address, "rbt-01").await?;
        Ok((observed && is_heard).then_some(()))
    })
    .await?;
    let told = until("the incident", LIMIT, async || {
        let told = incidents(server.address)?;
        Ok((!told.is_empty()).then_some(told))
    })
    .await?;
    let [incident] = told.as_slice() else { anyhow::bail!("more than one: {told:?}") };
    let reason = &incident["reason"];
    assert_eq!(
        (&incident["robotId"], &reason["code"]),
        (&Value::from("rbt-01"), &Value::from(Code::CloneSeen.as_str()))
    );
    assert_eq!(reason["metadata"]["certificate"], Value::from(serial(&elsewhere)?));

    // The original works on, and all is done as if there were no other.
    at_work(address, 4, &BTreeSet::new()).await?;
    let ended = all_over(address, TASKS).await?;
    judge(&ended, &BTreeSet::new(), &site, &robots)?;
    ensure!(!copy.has_ended()?, "the second machine stays where it can be seen");
    let mut written: Vec<_> = journal::read(&journal)?.into_iter().skip(before).collect();
    written.retain(|entry| !matches!(entry.effect, Effect::Ran { .. } | Effect::Obeys { .. } | Effect::Stood { .. }));
    ensure!(written.is_empty(), "the second machine did something: {written:?}");
    // Nor has it the line to the stop service, and that was written down.
    let audit = std::fs::read_to_string(dir.path().join("data/stop/audit.jsonl"))?;
    let held = audit.lines().filter(|line| line.contains(Code::LineHeld.as_str())).collect::<Vec<_>>();
    ensure!(held.len() == 1 && held[0].contains("rbt-01"), "{audit}");
    ensure!(incidents(server.address)?.len() == 1, "told once: {:?}", incidents(server.address)?);

    // Whoever it was: the key is worth nothing any more, on connections that stand and on new ones.
    done(&["robot", "revoke", "rbt-01", "--server", &address.to_string()])?;
    until("both are cut off", LIMIT, async || Ok((presence(address, "rbt-01").await? == (false, false)).then_some(())))
        .await?;
    ensure!(attach(&server, &elsewhere).await.is_err(), "a revoked key was let in");
    until("it says why, and what to try", LIMIT, async || {
        let said = std::fs::read_to_string(elsewhere.join("agent.log"))?;
        Ok((said.contains("this robot was revoked") && said.contains("midshift robot enroll rbt-01")).then_some(()))
    })
    .await?;
    for other in robots.ids().iter().skip(1) {
        ensure!(presence(address, other).await? == (false, true), "{other} is not concerned");
    }
    Ok(())
}

/// Uses the key of rbt-01 on a new connection.
async fn attach(server: &Server, folder: &Path) -> anyhow::Result<()> {
    use midshift_proto::identity::v1::RenewCertificateRequest;
    use midshift_proto::identity::v1::enrolment_service_client::EnrolmentServiceClient;
    let enrolled = Enrolled::read(folder)?.context("it is enrolled")?;
    let key = Robots::device(folder).await?;
    let dial = TcpDial::new(&format!("https://{}", server.address), None)?;
    let channel = dial.with_tls(Tls::fixed(enrolled.config(&key)?)).dial().await?;
    let request = RenewCertificateRequest { robot_id: "rbt-01".to_owned(), request_pem: String::new() };
    match EnrolmentServiceClient::new(channel).renew_certificate(request).await {
        // It was let in, and asked for nothing.
        Err(status) if status.code() == tonic::Code::InvalidArgument => Ok(()),
        Err(status) => Err(status.into()),
        Ok(_) => Ok(()),
    }
}

/// Whether a stop service lets the key of the robot in this folder in. What is stopped elsewhere is no robot's to see.
async fn is_let_in(stops: SocketAddr, folder: &Path) -> anyhow::Result<()> {
    let (enrolled, key) = (Enrolled::read(folder)?.context("it is enrolled")?, Robots::device(folder).await?);
    let dial = TcpDial::new(&format!("https://{stops}"), None)?;
    let channel = dial.with_tls(Tls::fixed(enrolled.config(&key)?)).dial().await?;
    match StopServiceClient::new(channel).get_status(GetStatusRequest {}).await {
        Err(status) if status.code() == tonic::Code::PermissionDenied => Ok(()),
        Err(status) => Err(status.into()),
        Ok(_) => bail!("a robot sees all of them"),
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_revoked_robot_is_cut_off_from_the_stop_service_too_and_stands_by_itself() -> anyhow::Result<()> {
    let dir = folder()?;
    let site: Site = with_robots(DEMO, 2)?;
    let server = Server::start_for(dir.path(), &site).await?;
    let stops = StopServer::start(dir.path(), server.address).await?;
    let (address, line) = (server.address, Some(stops.address));
    let robots = Robots::start_beside(dir.path(), address, address, line, &site).await?;
    let journals = robots.journals();
    let newest = |nth: usize| Ok::<_, anyhow::Error>(obeyed(&journals[nth])?.last().copied());
    until("both are let go", LIMIT, async || {
        Ok((newest(0)? == Some(StopLevel::None) && newest(1)? == Some(StopLevel::None)).then_some(()))
    })
    .await?;
    let folders = ["rbt-01", "rbt-02"].map(|id| dir.path().join(id));
    for folder in &folders {
        is_let_in(stops.address, folder).await?;
    }
    done(&["robot", "revoke", "rbt-01", "--server", &address.to_string()])?;
    // Its line does not stand any more: nobody answers its check-ins.
    until("it stands by silence", LIMIT, async || Ok((newest(0)? >= Some(StopLevel::Halt)).then_some(()))).await?;
    ensure!(is_let_in(stops.address, &folders[0]).await.is_err(), "a revoked key was let in");
    is_let_in(stops.address, &folders[1]).await.context("the other one is not concerned")?;
    ensure!(newest(1)? == Some(StopLevel::None), "{:?}", obeyed(&journals[1])?);
    Ok(())
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_secret_that_enrolled_one_machine_is_refused_to_the_next_and_a_new_one_enrols_it_anew() -> anyhow::Result<()>
{
    let dir = folder()?;
    let server = Server::start(dir.path()).await?;
    let site: Site = text::parse(DEMO)?;
    let secret = enrolment(server.address, "rbt-01").await?.context("a secret")?;
    let robots = Robots::waiting(dir.path(), server.address, &site, 1);
    let home = dir.path().join("rbt-01");
    let mut first = robots.run(0, &home, Some(&secret))?;
    until("the first machine", LIMIT, async || {
        Ok(presence(server.address, "rbt-01").await.ok().filter(|(_, is_heard)| *is_heard).map(drop))
    })
    .await?;
    let other = dir.path().join("other");
    let mut second: Running = robots.run(0, &other, Some(&secret))?;
    ensure!(second.ends().await? == Some(1), "the second machine was let in");
    let said = std::fs::read_to_string(other.join("agent.log"))?;
    ensure!(said.contains("was used"), "{said}");
    ensure!(Enrolled::read(&other)?.is_none() && incidents(server.address)?.is_empty(), "{said}");

    // As one does whose certificate ran out while it was off.
    first.kill()?;
    let known = Enrolled::read(&home)?.context("it is enrolled")?;
    let request = CreateEnrolmentRequest { robot_id: "rbt-01".to_owned(), replace: true };
    let offered = IdentityServiceClient::new(channel(server.address)?).create_enrolment(request).await?.into_inner();
    keep_secret("an enrolment", secret_part(&offered.secret)?);
    let mut again = robots.run(0, &home, Some(&offered.secret))?;
    until("another certificate", LIMIT, async || {
        let enrolled = Enrolled::read(&home)?.filter(|enrolled| enrolled.certificate_pem != known.certificate_pem);
        Ok(enrolled.map(drop))
    })
    .await?;
    again.kill()?;
    // The line that it was started with first is worth nothing, and it needs none.
    let _third = robots.run(0, &home, Some(&secret))?;
    until("it goes on with what it has", LIMIT, async || {
        let said = std::fs::read_to_string(home.join("agent.log"))?;
        Ok(said.contains("it goes on with the certificate that it has").then_some(()))
    })
    .await?;
    until("it is heard", LIMIT, async || {
        Ok(presence(server.address, "rbt-01").await.ok().filter(|(_, is_heard)| *is_heard).map(drop))
    })
    .await
}

/// The command line as the holder of this token has it.
pub fn call_as(server: SocketAddr, token: &str, arguments: &[&str]) -> anyhow::Result<Output> {
    let mut command = Command::new(midshift()?);
    sign_in(&mut command, server);
    command.env("MIDSHIFT_TOKEN", token).args(arguments).args(["--server", &server.to_string()]);
    heard(&mut command)
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_token_that_was_revoked_is_worth_nothing_at_the_stop_port_either_and_what_it_watched_ends()
-> anyhow::Result<()> {
    let dir = folder()?;
    let server = Server::start(dir.path()).await?;
    let stops = StopServer::start(dir.path(), server.address).await?;
    let made = json(server.address, &["token", "create", "bert", "--role", "viewer"])?;
    let token = made["secret"].as_str().context("a secret")?;
    let token_id = made["token"]["tokenId"].as_str().or(made["token"]["token_id"].as_str()).context("an id")?;
    let stop_port = stops.address.to_string();
    let as_bert = |more: &[&str]| {
        let mut command = Command::new(midshift()?);
        sign_in(&mut command, stops.address);
        command.env("MIDSHIFT_TOKEN", token).args(["stop", "status", "--stop-server", &stop_port]).args(more);
        anyhow::Ok(command)
    };
    until("the stop port to know the token", LIMIT, async || Ok(as_bert(&[])?.status()?.success().then_some(())))
        .await?;
    let mut watching = Running::start(&mut as_bert(&["--watch"])?, &dir.path().join("watching.log"))?;
    until("the first word to whoever watches", LIMIT, async || {
        Ok((!std::fs::read_to_string(dir.path().join("watching.log"))?.is_empty()).then_some(()))
    })
    .await?;
    done(&["token", "revoke", token_id, "--server", &server.address.to_string()])?;
    until("the stop port to know that it is none any more", LIMIT, async || {
        let output = as_bert(&[])?.output()?;
        let said = String::from_utf8_lossy(&output.stderr).into_owned();
        Ok((!output.status.success() && said.contains("none of this site")).then_some(()))
    })
    .await?;
    ensure!(watching.ends().await?.is_some_and(|code| code != 0), "it goes on");
    Ok(())
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_token_that_acts_outside_its_area_is_denied_and_that_stands_in_the_audit() -> anyhow::Result<()> {
    let dir = folder()?;
    let server = Server::start(dir.path()).await?;
    done(&[
        "task",
        "submit",
        "--task-id",
        "T1",
        "--from",
        "A01",
        "--to",
        "A02",
        "--server",
        &server.address.to_string(),
    ])?;
    let made = json(server.address, &["token", "create", "bert", "--role", "viewer,dispatcher@packing"])?;
    let token = made["secret"].as_str().context("a secret")?;
    let cancel = ["task", "cancel", "T1", "--reason", "in my way", "--request-id", "c1"];
    let output = call_as(server.address, token, &cancel)?;
    let said = String::from_utf8_lossy(&output.stderr);
    ensure!(output.status.code() == Some(6) && said.contains("bert may not"), "{output:?}");
    let rows = json(server.address, &["audit", "ls", "--actor", "bert"])?;
    let [row] = rows["rows"].as_array().map(Vec::as_slice).unwrap_or_default() else { anyhow::bail!("{rows}") };
    assert_eq!(
        (&row["action"], &row["outcome"]),
        (&Value::from("task.cancel"), &Value::from(Code::NotPermitted.as_str()))
    );
    let task = json(server.address, &["task", "get", "T1"])?;
    ensure!(
        task["task"]["state"] == "TASK_STATE_QUEUED" && task["task"]["etag"] == "1",
        "something became of it: {task}"
    );
    Ok(())
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn doctor_looks_at_certificates_tokens_rights_and_for_the_stop_service() -> anyhow::Result<()> {
    let dir = folder()?;
    let mut server = Server::start(dir.path()).await?;
    let _secret = enrolment(server.address, "rbt-01").await?;
    let (address, data) = (server.address.to_string(), server.data().display().to_string());
    let nobody = "127.0.0.1:1";
    let output = call(&["doctor", "--server", &address, "--data", &data, "--stop-server", nobody, "-o", "json"])?;
    ensure!(output.status.code() == Some(1), "{output:?}");
    let found: Vec<Value> = serde_json::from_slice(&output.stdout)?;
    let of = |check: &str| -> Vec<(bool, &str)> {
        let of = found.iter().filter(|finding| finding["check"] == check);
        of.filter_map(|finding| Some((finding["good"].as_bool()?, finding["text"].as_str()?))).collect()
    };
    let [(true, leaf), (true, root), (true, robots)] = of("certificates")[..] else { anyhow::bail!("{found:?}") };
    ensure!(leaf.starts_with("the server's ends ") && leaf.ends_with(" in 89 days"), "{leaf}");
    ensure!(root.starts_with("the site's root ends "), "{root}");
    assert_eq!(robots, "no robot is enrolled");
    let [(false, tokens)] = of("tokens")[..] else { anyhow::bail!("{found:?}") };
    ensure!(tokens.contains("within 14 days end: second;"), "{tokens}");
    ensure!(of("exposure").iter().all(|(good, _)| *good) && of("exposure").len() == 2, "{found:?}");
    ensure!(of("disk").len() == 1 && of("clocks")[0] == (true, "the server and this machine agree"), "{found:?}");
    let [(false, stop)] = of("stop")[..] else { anyhow::bail!("{found:?}") };
    ensure!(stop.contains("`midshift-stop`"), "{stop}");

    // What the clock jumped before the server was started again is told too.
    let kept = serde_json::json!({ "step_ms": -7_200_000, "to_unix_ms": midshift_agent::clock::wall().0 });
    std::fs::write(server.data().join("clock-jump.json"), kept.to_string())?;
    server.kill_and_restart().await?;
    let output = call(&["doctor", "--server", &address, "--data", &data, "--stop-server", nobody])?;
    let told = String::from_utf8(output.stdout)?;
    ensure!(told.contains("the server's jumped 7200 s back at "), "{told}");
    Ok(())
}

/// Has a shell read the line that `robot enroll` prints, as it is printed, until the server hears the robot.
async fn joins_as_printed(dir: &Path, server: SocketAddr, flags: &[&str]) -> anyhow::Result<()> {
    let address = server.to_string();
    let output = call(&[&["robot", "enroll", "rbt-01", "--server", &address][..], flags].concat())?;
    ensure!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let printed = String::from_utf8(output.stdout)?;
    let program = midshift()?;
    let programs = program.parent().context("a folder")?;
    let path = format!("{}:{}", programs.display(), std::env::var("PATH")?);
    let mut shell = Command::new("sh");
    shell.current_dir(dir).env("PATH", path).args(["-c", &printed]).process_group(0);
    let robot = Running::start(&mut shell, &dir.join("robot.log"))?;
    let heard = until("the robot", LIMIT, async || {
        Ok(presence(server, "rbt-01").await.ok().filter(|(_, is_heard)| *is_heard).map(drop))
    })
    .await;
    robot.signal_group("KILL")?;
    heard
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_line_that_enrolls_a_robot_makes_a_machine_that_robot_as_a_shell_reads_it() -> anyhow::Result<()> {
    let dir = folder()?;
    let server = Server::start_on(dir.path(), CORRIDOR).await?;
    let (address, site) = (server.address.to_string(), dir.path().join("a site.toml"));
    std::fs::write(&site, CORRIDOR)?;
    let warned = call(&["robot", "enroll", "rbt-02", "--server", &address])?;
    let warned = String::from_utf8_lossy(&warned.stderr).into_owned();
    ensure!(warned.contains("corridor") && warned.contains("--site FILE"), "{warned}");
    joins_as_printed(dir.path(), server.address, &["--site", site.to_str().context("a plain path")?]).await
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_line_that_enrolls_a_robot_of_a_split_site_leads_it_through_both_doors_of_machines() -> anyhow::Result<()> {
    let dir = folder()?;
    let stack = Stack::start(dir.path(), DEMO, &["--no-software"], &[]).await?;
    let doors = [stack.robots, machines_of(stack.robots)].map(|door| door.to_string());
    ensure!(doors[0] != doors[1] && !doors.contains(&stack.public.to_string()), "three doors: {doors:?}");
    let flags = ["--link-server", &doors[0], "--identity-server", &doors[1]];
    joins_as_printed(dir.path(), stack.public, &flags)
        .await
        .with_context(|| std::fs::read_to_string(dir.path().join("robot.log")).unwrap_or_default())
}
