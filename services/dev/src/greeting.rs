//! What `dev` says first: what runs where, and what to try.

use super::args::Dev;
use midshift_core::site::Site;
use midshift_core::stop::PORT;
use std::net::SocketAddr;
use std::path::PathBuf;

/// The greeting. `made`: the folders of keys and of the repository.
pub fn greeting(args: &Dev, site: &Site, address: SocketAddr, stops: SocketAddr, made: (PathBuf, PathBuf)) -> String {
    let program = std::env::args().next().unwrap_or_else(|| "midshift".to_owned());
    let (keys, repository) = (made.0.display(), made.1.display());
    let kept = args
        .data
        .as_ref()
        .map_or("data in memory (--data DIR keeps it)".to_owned(), |d| format!("data in {}", d.display()));
    let server = if address.port() == 7420 { String::new() } else { format!(" --server {address}") };
    let stop_server = if stops.port() == PORT { String::new() } else { format!(" --stop-server {stops}") };
    let mut stations =
        site.stations().chain(site.of_kind(midshift_core::site::Kind::Junction)).map(|w| site.name_of(w).to_string());
    let (from, to) = if site.source() == midshift_core::site::Source::Authored && site.site_id().as_str() == "demo" {
        ("A01".to_owned(), "B03".to_owned())
    } else {
        (stations.next().unwrap_or_default(), stations.next().unwrap_or_default())
    };
    let clock = match args.scenario {
        _ if args.speedup == 1.0 => String::new(),
        // The clock of a story is the wall's.
        Some(_) => format!(", bodies x{}", args.speedup),
        None => format!(", site clock x{} (task times run ahead of the wall)", args.speedup),
    };
    format!(
        "midshift dev  {} simulated robots, site \"{}\", {kept}{clock}\n\
         gRPC http://{address} (reflection on)   metrics http://{address}/metrics   no login, no TLS: NOT for production\n\
         Stop http://{stops}: an operational stop request, not a safety function\n\
         Try:  {program} task submit{server} --from {from} --to {to} --sku SKU-88231 --wait\n\
         \x20     {program} robot ls{server}\n\
         \x20     {program} sim fault{server} rbt-04 --drop-network 20s\n\
         \x20     {program} stop{stop_server} --all --reason drill\n\
         \x20     grpcurl -plaintext {address} list\n\
         \x20     {program} bundle samples SAMPLES --config-only --repository {repository} --key {keys}/targets-1.pem\n\
         \x20     {program} bundle push{server} {repository}\n\
         Ctrl-C ends it.",
        args.robots,
        site.site_id(),
    )
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::Parser;
    use midshift_cli::site_file;

    #[derive(Parser)]
    struct Line {
        #[command(flatten)]
        dev: Dev,
    }

    #[test]
    fn the_greeting_says_what_runs_where_and_how_to_put_a_bad_release_into_it() -> anyhow::Result<()> {
        let args = Line::parse_from(["dev"]).dev;
        let site = site_file::load(None, None, None)?.site;
        let made = (PathBuf::from("KEYS"), PathBuf::from("REPOSITORY"));
        let text = greeting(&args, &site, "127.0.0.1:7420".parse()?, "127.0.0.1:7421".parse()?, made);
        let lines: Vec<&str> = text.lines().collect();
        assert_eq!(
            lines[..3],
            [
                "midshift dev  12 simulated robots, site \"demo\", data in memory (--data DIR keeps it)",
                "gRPC http://127.0.0.1:7420 (reflection on)   metrics http://127.0.0.1:7420/metrics   no login, no TLS: NOT for production",
                "Stop http://127.0.0.1:7421: an operational stop request, not a safety function",
            ]
        );
        for command in [
            "bundle samples SAMPLES --config-only --repository REPOSITORY --key KEYS/targets-1.pem",
            "bundle push REPOSITORY",
        ] {
            assert!(lines.iter().any(|line| line.ends_with(command)), "{text}");
        }
        Ok(())
    }

    #[test]
    fn the_greeting_says_what_of_a_run_is_faster_than_real() -> anyhow::Result<()> {
        let site = site_file::load(None, None, None)?.site;
        let first = |line: &[&str]| -> anyhow::Result<String> {
            let (args, made) = (Line::parse_from(line).dev, (PathBuf::new(), PathBuf::new()));
            let text = greeting(&args, &site, "127.0.0.1:7420".parse()?, "127.0.0.1:7421".parse()?, made);
            Ok(text.lines().next().unwrap_or_default().to_owned())
        };
        assert!(first(&["dev", "--speedup", "10"])?.ends_with(", site clock x10 (task times run ahead of the wall)"));
        let story = ["dev", "--speedup", "10", "--scenario", "update-midshift"];
        assert!(first(&story)?.ends_with(", bodies x10"), "its clock is the wall's");
        Ok(())
    }
}
