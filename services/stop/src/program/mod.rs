//! The program `midshift-stop`: the stop service in a process of its own, which outlives the server beside it.
//!
//! Invariant: nothing of the store, the task queue or the business server lies on its way; it links none of them. Rooms:
//! `principals` follows who is known, `next` is how one takes the place of another, `manager` what a service manager
//! hears.

mod manager;
mod next;
mod principals;

pub use next::UP_WITHIN;

use crate::inner::Parts;
use crate::service::StopService;
use crate::{folder, port};
use anyhow::{Context, bail, ensure};
use clap::Parser;
use midshift_core::site::{Site, file};
use midshift_core::stop::{FOLDER, PORT};
use midshift_core::{Boxed, limits};
use midshift_os::told_to_end;
use midshift_process::door::Share;
use midshift_process::{clock, logs, recorder};
use std::io::Write;
use std::net::SocketAddr;
use std::os::fd::AsFd;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::{Arc, OnceLock};
use std::time::Duration;
use tokio::net::TcpListener;
use tokio_util::sync::CancellationToken;

/// How often one that follows looks whether the folder is free: nobody is answered meanwhile.
const NEXT_EVERY: Duration = Duration::from_millis(10);

/// What it says of itself. A program that was built for tests may have their naive rules in it and says so: none is
/// ever released.
const VERSION: &str = if midshift_core::task::bugs::Bugs::ARE_BUILT_IN {
    concat!(env!("CARGO_PKG_VERSION"), " with seeded bugs, for tests only")
} else {
    env!("CARGO_PKG_VERSION")
};

/// The stop service of a site: operational stop requests for its robots, on a port and files of its own. Not a safety
/// function.
///
/// It runs beside `midshift serve`, which starts it where no unit or container does, and works without it. SIGUSR2 has
/// the program at this path take its place, on the same open port.
#[derive(Clone, Debug, Parser)]
#[command(name = "midshift-stop", version = VERSION)]
pub struct Args {
    /// The site file, as for `midshift serve`: where areas and zones are. Without it the built-in demo site.
    #[arg(long)]
    pub site: Option<PathBuf>,
    /// The data folder; its own files are in stop below it, made with mode 0700.
    #[arg(long, default_value = "midshift-data")]
    pub data: PathBuf,
    /// Address to listen on.
    #[arg(long, default_value_t = SocketAddr::from(([127, 0, 0, 1], PORT)))]
    pub listen: SocketAddr,
    /// No TLS and no login: whoever reaches the port may stop the fleet and reset stops.
    #[arg(long)]
    pub insecure: bool,
    /// What one peer may take.
    #[command(flatten)]
    pub share: Share,
    /// How log lines look (stderr); their level by MIDSHIFT_LOG.
    #[arg(long, value_enum, default_value_t = logs::Format::Text)]
    pub log: logs::Format,
    /// Takes the place of the stop service that has started this one, on its open port.
    #[arg(long, hide = true)]
    pub follows: bool,
}

/// Reads the arguments, serves until Ctrl-C, SIGTERM or the next one, gives the exit code.
pub fn main() -> ExitCode {
    let args = Args::parse();
    logs::start(args.log, "info");
    let ended = start(args);
    let Err(error) = ended else { return ExitCode::SUCCESS };
    // Where nobody reads it, it is lost.
    let _ = writeln!(std::io::stderr(), "error: {error:#}");
    ExitCode::FAILURE
}

fn start(args: Args) -> anyhow::Result<()> {
    let runtime = tokio::runtime::Builder::new_multi_thread().enable_all().build().context("starting the runtime")?;
    let shutdown = CancellationToken::new();
    let told = async {
        told_to_end().await;
        shutdown.cancel();
        std::future::pending().await
    };
    let ended = runtime.block_on(async {
        tokio::select! {
            served = run(args, shutdown.clone()) => served,
            never = told => never,
            () = logs::count_floods() => unreachable!("it counts for as long as it is let"),
        }
    });
    runtime.shutdown_timeout(Duration::from_secs(2));
    ended
}

/// Serves until `shutdown`, or until another one that SIGUSR2 has asked for takes its place.
///
/// # Errors
/// The folder cannot be used or another process has it, the port is taken, or a part ended by itself.
pub fn run(args: Args, shutdown: CancellationToken) -> Boxed<'static, anyhow::Result<()>> {
    Box::pin(async move {
        let opened = OnceLock::new();
        tokio::select! {
            served = run_watched(args, shutdown, &opened) => served,
            () = manager::is_watched(&opened) => Ok(()),
        }
    })
}

async fn run_watched(args: Args, shutdown: CancellationToken, opened: &OnceLock<StopService>) -> anyhow::Result<()> {
    let asked = next::listen()?;
    if args.insecure {
        tracing::warn!(address = %args.listen, "no TLS and no login: whoever reaches this port may stop the fleet and reset stops");
    }
    if !args.insecure {
        // Who is known, and what this port proves itself with, lie below it.
        midshift_durable::make_private_folder(&args.data)
            .with_context(|| format!("opening the data folder: {}", args.data.display()))?;
    }
    let site = load_site(args.site.as_deref())?;
    let listener = match args.follows {
        true => next::port()?,
        false => TcpListener::bind(args.listen).await.with_context(|| format!("listening on {}", args.listen))?,
    };
    let open = listener.as_fd().try_clone_to_owned()?;
    let folder = args.data.join(FOLDER);
    recorder::handle();
    tracing::info!(address = %listener.local_addr()?, folder = %folder.display(), "midshift-stop serves: an operational stop request, not a safety function");
    let clock = clock::clock(1000);
    let (config, login) = match args.insecure {
        true => (args.share.config_without_login(port::NAME), None),
        false => (args.share.config(port::NAME)?, Some(principals::follow(&folder, &site, &clock).await?)),
    };
    let parts = Parts { folder, site: Some(site), clock };
    let service = match args.follows {
        true => {
            if let Some((login, ..)) = &login {
                login.proves()?;
            }
            following(&parts, &shutdown).await?
        }
        false => StopService::open(parts, shutdown.clone())?,
    };
    let leaving = opened.get_or_init(|| service.clone());
    let following = async {
        tokio::select! {
            () = shutdown.cancelled() => {}
            () = next::begun(asked, &open, leaving) => {}
        }
        // Who dials from now on is the next one's.
        drop(open);
        std::future::pending().await
    };
    tokio::select! {
        served = port::serve(service, (config, login), listener) => served,
        never = following => never,
    }
}

/// The site in a file; none: the built-in demo.
fn load_site(path: Option<&Path>) -> anyhow::Result<Arc<Site>> {
    let Some(path) = path else { return Ok(file::demo(None)?.site) };
    let body = midshift_durable::read_text(path, limits::SITE_FILE_BYTES as u64);
    Ok(file::parse(path, body.with_context(|| format!("reading {}", path.display()))?, None)?.site)
}

/// Opens the folder as soon as the one before has let go of it, which it does when this one has read everything else.
async fn following(parts: &Parts, shutdown: &CancellationToken) -> anyhow::Result<StopService> {
    // One that cannot read it would stop the whole fleet.
    let latch = folder::latch(&parts.folder).context("reading the latch")?;
    ensure!(latch.is_some(), "there is no latch in {}", parts.folder.display());
    let mut waited = Duration::ZERO;
    loop {
        match StopService::open(parts.clone(), shutdown.clone()) {
            Err(error) if error.is_held() && waited < UP_WITHIN => {}
            opened => return Ok(opened?),
        }
        if waited.is_zero() {
            // It could have it, but for the one before.
            next::ready()?;
        }
        tokio::select! {
            () = shutdown.cancelled() => bail!("asked to end before it began"),
            () = tokio::time::sleep(NEXT_EVERY) => waited += NEXT_EVERY,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::Args;
    use clap::CommandFactory;

    #[test]
    fn the_arguments_hang_together() {
        Args::command().debug_assert();
    }
}
