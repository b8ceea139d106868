//! Robots and stops by the beginning of their ids, as a person types them.

use crate::harness::{Server, folder};
use crate::robots::{Robots, with_robots};
use crate::rolled_out::call;
use crate::stopped::{StopServer, until_held};
use anyhow::ensure;
use midshift_core::site::{DEMO, Site};

/// What a command prints with `-o name`.
fn named(arguments: &[&str]) -> anyhow::Result<String> {
    let output = call(&[arguments, &["-o", "name"]].concat())?;
    ensure!(output.status.success(), "{arguments:?}: {}", String::from_utf8_lossy(&output.stderr));
    Ok(String::from_utf8(output.stdout)?.trim().to_owned())
}

/// Exit code and words of a command that must not succeed.
fn refused(arguments: &[&str]) -> anyhow::Result<(Option<i32>, String)> {
    let output = call(arguments)?;
    ensure!(!output.status.success(), "{arguments:?} succeeded");
    Ok((output.status.code(), String::from_utf8_lossy(&output.stderr).into_owned()))
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_robot_and_a_stop_are_meant_by_a_beginning_that_only_they_have() -> anyhow::Result<()> {
    let dir = folder()?;
    let site: Site = with_robots(DEMO, 1)?;
    let server = Server::start_for(dir.path(), &site).await?;
    let stops = StopServer::start(dir.path(), server.address).await?;
    let (at, stop_at) = (server.address.to_string(), stops.address.to_string());
    let beside = Some(stops.address);
    let robot = Robots::start_beside(dir.path(), server.address, server.address, beside, &site).await?;
    for (verb, typed) in [("get", "rbt-01"), ("get", "r"), ("explain", "rbt"), ("uncordon", "rbt-0")] {
        ensure!(named(&["robot", verb, typed, "--server", &at])? == "rbt-01", "{verb} {typed}");
    }
    let (code, said) = refused(&["robot", "get", "rbt-01x", "--server", &at])?;
    ensure!(code == Some(4) && said.contains("No robot has this id"), "{code:?} {said}");

    let engage = || named(&["stop", "--all", "--no-wait", "--reason", "tried", "--stop-server", &stop_at]);
    let (first, second) = (engage()?, engage()?);
    for stop_id in [&first, &second] {
        until_held(server.address, &robot.ids(), &format!("stop:{stop_id}")).await?;
    }
    let common = first.bytes().zip(second.bytes()).take_while(|(a, b)| a == b).count();
    let reset =
        |typed: &str| ["stop", "reset", typed, "--reason", "tried", "--stop-server", &stop_at].map(str::to_owned);
    fn words(line: &[String]) -> Vec<&str> {
        line.iter().map(String::as_str).collect()
    }
    let (code, said) = refused(&words(&reset(&first[..common])))?;
    ensure!(code == Some(2) && said.contains(&first) && said.contains(&second), "{code:?} {said}");
    ensure!(stops.engaged().await?.len() == 2, "nothing was reset");
    ensure!(named(&words(&reset(&first[..=common])))? == first, "by its beginning");
    ensure!(named(&words(&reset(&second)))? == second, "by its name");
    ensure!(stops.engaged().await?.is_empty(), "both are reset");
    let (code, said) = refused(&words(&reset("STOP-1998")))?;
    ensure!(code == Some(9) && said.contains("nobody knows a stop STOP-1998"), "{code:?} {said}");

    for stop_id in [&first, &second] {
        until_held(server.address, &robot.ids(), &format!("resume:{stop_id}")).await?;
    }
    let resume = |typed: &str| ["resume", "--stop", typed, "--reason", "tried", "--server", &at].map(str::to_owned);
    let (code, said) = refused(&words(&resume(&first[..common])))?;
    ensure!(code == Some(2) && said.contains(&first) && said.contains(&second), "{code:?} {said}");
    let (code, said) = refused(&words(&resume("STOP-1999")))?;
    ensure!(code == Some(4) && said.contains("Nothing is known of this stop"), "{code:?} {said}");
    named(&words(&resume(&first[..=common])))?;
    named(&words(&resume(&second)))?;
    Ok(())
}
