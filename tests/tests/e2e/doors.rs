//! Wrong doors: what people, a second server and a robot are told where no server of their site answers.

use crate::harness::{Running, Server, folder, free_port, has_login, midshift, sign_in, token, tool, until};
use crate::room::LIMIT;
use crate::stopped::StopServer;
use anyhow::{Context, ensure};
use std::net::{SocketAddr, TcpListener};
use std::path::Path;
use std::process::{Command, Output};
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;
use tokio_util::task::AbortOnDropHandle;

/// A command of somebody who is signed in nowhere.
fn stranger(dir: &Path, arguments: &[&str]) -> anyhow::Result<Output> {
    let mut command = Command::new(midshift()?);
    command.env_remove("MIDSHIFT_TOKEN").env("MIDSHIFT_CONTEXTS", dir.join("contexts.toml")).args(arguments);
    tokio::task::block_in_place(|| Ok(command.output()?))
}

/// Asks for tasks there: the exit code must be this one, and each of these must be said.
fn asked(dir: &Path, address: SocketAddr, code: i32, told: &[&str]) -> anyhow::Result<()> {
    let output = stranger(dir, &["task", "ls", "--server", &address.to_string()])?;
    let said = String::from_utf8_lossy(&output.stderr);
    ensure!(output.status.code() == Some(code), "{:?} instead of {code}: {said}", output.status.code());
    told.iter().try_for_each(|words| {
        ensure!(said.contains(words), "{words:?} is not in {said}");
        Ok(())
    })
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn each_wrong_door_says_what_it_is_and_what_to_try() -> anyhow::Result<()> {
    let dir = folder()?;
    asked(dir.path(), free_port()?, 5, &["no server at", "midshift dev"])?;
    let silent = TcpListener::bind("127.0.0.1:0")?;
    asked(dir.path(), silent.local_addr()?, 10, &["says nothing", "it may hang"])?;

    let server = Server::start(dir.path()).await?;
    asked(dir.path(), server.address, 5, &["it speaks TLS", "midshift login"])?;
    let stops = StopServer::start(dir.path(), server.address).await?;
    let wrong = crate::harness::command(&["task", "ls", "--server", &stops.address.to_string()])?.output()?;
    let said = String::from_utf8_lossy(&wrong.stderr);
    ensure!(wrong.status.code() == Some(5) && said.contains("stops are at 7421"), "{:?} {said}", wrong.status);
    Ok(())
}

/// The first bytes that a port says to a request of HTTP/1.1 in plain text.
async fn first_bytes(address: SocketAddr, path: &str) -> anyhow::Result<Vec<u8>> {
    let mut stream = TcpStream::connect(address).await?;
    stream.write_all(format!("GET {path} HTTP/1.1\r\nhost: site\r\nconnection: close\r\n\r\n").as_bytes()).await?;
    let mut said = Vec::new();
    // Closed with bytes unread it is a reset: closed all the same.
    let _ = stream.read_to_end(&mut said).await;
    Ok(said)
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn tls_and_plain_text_each_say_what_the_other_is_and_so_does_a_port_of_metrics() -> anyhow::Result<()> {
    let dir = folder()?;
    let server = Server::start(dir.path()).await?;
    ensure!(has_login(server.address), "a site with login");
    let said = first_bytes(server.address, "/metrics").await?;
    ensure!(said.first() == Some(&0x15), "TLS says that this is none: {said:?}");

    // The same commands, signed in, at a server without a login.
    let (plain, data) = (free_port()?, dir.path().join("plain"));
    let mut command = Command::new(midshift()?);
    command.args(["serve", "--insecure", "--no-stop", "--listen", &plain.to_string(), "--data"]).arg(&data);
    let _plain = Running::start(&mut command, &dir.path().join("plain.log"))?;
    until("a page of metrics in plain text", LIMIT, async || {
        let Ok(said) = first_bytes(plain, "/metrics").await else { return Ok(None) };
        Ok(said.starts_with(b"HTTP/1.1 200").then_some(()))
    })
    .await?;
    let signed_in = |address: SocketAddr| {
        let mut command = Command::new(midshift()?);
        sign_in(&mut command, server.address);
        command.args(["task", "ls", "--server", &address.to_string()]);
        tokio::task::block_in_place(|| Ok::<_, anyhow::Error>(command.output()?))
    };
    let output = signed_in(plain)?;
    let said = String::from_utf8_lossy(&output.stderr);
    ensure!(output.status.code() == Some(5) && said.contains("it speaks plain text"), "{:?} {said}", output.status);

    // Over TLS a hung server is told as well.
    let silent = TcpListener::bind("127.0.0.1:0")?;
    let output = signed_in(silent.local_addr()?)?;
    let said = String::from_utf8_lossy(&output.stderr);
    ensure!(output.status.code() == Some(10) && said.contains("it may hang"), "{:?} {said}", output.status);

    // Metrics of another program: HTTP/1.1 and nothing else.
    let page = tokio::net::TcpListener::bind("127.0.0.1:0").await?;
    let address = page.local_addr()?;
    let _page = AbortOnDropHandle::new(tokio::spawn(async move {
        loop {
            let Ok((mut stream, _)) = page.accept().await else { return };
            let mut asked = [0; 16];
            if stream.read_exact(&mut asked).await.is_ok() {
                let _ = stream.write_all(b"HTTP/1.1 400 Bad Request\r\ncontent-length: 0\r\n\r\n").await;
            }
        }
    }));
    asked(dir.path(), address, 5, &["HTTP/1.1 and no gRPC", "7420"])
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_second_server_on_a_port_says_so_and_leaves_no_trace() -> anyhow::Result<()> {
    let dir = folder()?;
    let server = Server::start(dir.path()).await?;
    let (second, port) = (dir.path().join("second"), server.address.to_string());
    let path = second.to_str().context("a plain path")?;
    let output = stranger(dir.path(), &["serve", "--data", path, "--listen", &port])?;
    let said = String::from_utf8_lossy(&output.stderr);
    ensure!(output.status.code() == Some(1) && said.contains("--listen"), "{:?} {said}", output.status);
    ensure!(!second.exists(), "it has made {path}");
    ensure!(server.in_states(&[]).await?.is_some(), "the first one answers");
    Ok(())
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_robot_at_a_dead_port_says_that_nobody_is_there() -> anyhow::Result<()> {
    let dir = folder()?;
    let mut command = Command::new(midshift()?);
    command.env("MIDSHIFT_LOG", "warn").args(["agent", "run", "--robot-id", "rbt-01", "--start", "park-1"]);
    command.args(["--no-faults", "--no-stop", "--server", &free_port()?.to_string()]);
    command.arg("--data").arg(dir.path().join("robot"));
    let log = dir.path().join("robot.log");
    let _robot = Running::start(&mut command, &log)?;
    until("word of it", LIMIT, async || {
        let said = std::fs::read_to_string(&log)?;
        Ok((said.contains("no session") && said.contains("refused")).then_some(()))
    })
    .await
}

/// Runs a command on a terminal and prints what that has shown. What is to be typed is typed once it is asked for and not shown any more.
pub const TERMINAL: &str = r"
import os, pty, sys, termios
child, terminal = pty.fork()
if child == 0:
    os.execv(sys.argv[1], sys.argv[1:])
shown = b''
if 'TYPED' in os.environ:
    while b'Enter' not in shown:
        shown += os.read(terminal, 1024)
    while termios.tcgetattr(terminal)[3] & termios.ECHO:
        pass
    os.write(terminal, os.environ['TYPED'].encode() + b'\n')
try:
    while part := os.read(terminal, 1024):
        shown += part
except OSError:
    pass
print(shown.decode())
sys.exit(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
";

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_token_that_is_typed_is_not_shown() -> anyhow::Result<()> {
    let dir = folder()?;
    let server = Server::start(dir.path()).await?;
    ensure!(has_login(server.address), "a site with login");
    let secret = token(server.address).context("a token")?;
    let mut typist = Command::new(tool("MIDSHIFT_TEST_PYTHON")?);
    typist.env_remove("MIDSHIFT_TOKEN").env("MIDSHIFT_CONTEXTS", dir.path().join("contexts.toml"));
    typist.env("TYPED", &secret).args(["-c", TERMINAL]).arg(midshift()?);
    typist.args(["login", &server.address.to_string(), "--ca"]).arg(server.data().join("identity/ca.pem"));
    let output = tokio::task::block_in_place(|| typist.output())?;
    let shown = String::from_utf8_lossy(&output.stdout);
    ensure!(output.status.success(), "{shown} {}", String::from_utf8_lossy(&output.stderr));
    ensure!(!shown.contains(secret.trim()), "the terminal showed it");
    let output = stranger(dir.path(), &["task", "ls"])?;
    ensure!(output.status.success(), "signed in by it: {}", String::from_utf8_lossy(&output.stderr));
    Ok(())
}
