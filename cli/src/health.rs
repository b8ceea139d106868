//! `midshift health`: whether one process serves, for whoever watches over it: a container's health check, a start script. One question, no shell.
//!
//! The exit code is 0 or 1 and nothing else, as those who ask want it.

use super::client::{Call, Exit, Resolved, unary};
use super::out::{Format, Out};
use std::time::Duration;
use tokio::io::{AsyncBufReadExt, AsyncWriteExt, BufReader};
use tonic_health::pb::HealthCheckRequest;
use tonic_health::pb::health_check_response::ServingStatus;

/// The longest first line of an answer that is read, bytes.
const LINE_MAX: u64 = 1024;

/// Which process, and what of it.
#[derive(clap::Args)]
pub struct Health {
    #[command(flatten)]
    call: Call,
    /// Ask GET /ready over HTTP/1.1, as a proxy does, instead of gRPC health.
    #[arg(long)]
    ready: bool,
    /// One service of it, e.g. midshift.fleet.v1.FleetService. Without it the whole process.
    #[arg(long, default_value = "", conflicts_with = "ready", hide_default_value = true)]
    service: String,
    /// It must have answered within this.
    #[arg(long, value_parser = super::duration, default_value = "3s")]
    timeout: Duration,
}

/// Asks; exit code 1 if it does not serve, or does not say so in time.
pub async fn run(args: Health, out: &Out) -> Result<(), Exit> {
    let resolved = args.call.resolved()?;
    let asked = async {
        match args.ready {
            true => ready(&resolved).await,
            false => serving(&args.call, args.service.clone()).await,
        }
    };
    let answer = tokio::time::timeout(args.timeout, asked).await;
    let answer = answer.unwrap_or_else(|_| Err(format!("no answer within {:?}", args.timeout)));
    let server = &resolved.server;
    let status = answer.map_err(|why| Exit::new(1, format!("{server}: {why}")))?;
    match out.format {
        Format::Table => out.line(&format!("{server}: {status}")),
        Format::Name => out.line(server),
        Format::Json | Format::Jsonl => out.value(&serde_json::json!({"server": server, "status": status}))?,
    }
    Ok(())
}

async fn serving(call: &Call, service: String) -> Result<&'static str, String> {
    let mut health = call.health().await.map_err(|_| "nothing answers".to_owned())?;
    let answer = health.check(unary(HealthCheckRequest { service })).await.map_err(|status| match status.code() {
        tonic::Code::NotFound => "it has no such service".to_owned(),
        code => format!("{code}: {}", status.message()),
    })?;
    match answer.get_ref().status() {
        ServingStatus::Serving => Ok("serving"),
        other => Err(other.as_str_name().to_lowercase().replace('_', " ")),
    }
}

async fn ready(resolved: &Resolved) -> Result<&'static str, String> {
    let failed = |error: std::io::Error| error.to_string();
    let endpoint = resolved.endpoint(&resolved.server).map_err(|exit| exit.to_string())?;
    let mut stream = endpoint.wire().await.map_err(failed)?;
    let request = format!("GET /ready HTTP/1.1\r\nHost: {}\r\nConnection: close\r\n\r\n", resolved.server);
    stream.write_all(request.as_bytes()).await.map_err(failed)?;
    let mut line = String::new();
    let mut answer = BufReader::new(tokio::io::AsyncReadExt::take(stream, LINE_MAX));
    answer.read_line(&mut line).await.map_err(failed)?;
    read_status_line(&line)
}

/// Reads the first line of an answer over HTTP/1.1.
fn read_status_line(line: &str) -> Result<&'static str, String> {
    let code = line.strip_prefix("HTTP/1.1 ").and_then(|rest| rest.split(' ').next()).map(str::trim);
    match code {
        Some("200") => Ok("ready"),
        Some("503") => Err("not ready".to_owned()),
        _ => Err(format!("that is no midshift server, it answered {:?}", line.trim_end())),
    }
}

#[cfg(test)]
mod tests {
    use super::read_status_line;

    #[test]
    fn only_200_is_ready() {
        assert_eq!(read_status_line("HTTP/1.1 200 OK\r\n"), Ok("ready"));
        assert_eq!(read_status_line("HTTP/1.1 503 Service Unavailable\r\n"), Err("not ready".to_owned()));
        for other in ["HTTP/1.1 404 Not Found\r\n", "HTTP/1.1 2000 OK\r\n", "SSH-2.0\r\n", ""] {
            assert!(read_status_line(other).is_err(), "{other}");
        }
    }
}
