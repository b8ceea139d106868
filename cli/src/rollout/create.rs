//! `midshift rollout create`: what a roll-out is asked to be, in flags.

use super::commands::{begin, show};
use super::parse::{pair, rate, wave};
use super::text;
use crate::client::{Call, Exit, unary};
use crate::duration::span;
use crate::out::{Out, columns};
use clap::ValueEnum;
use midshift_proto::ota::v1;
use std::time::Duration;

/// Robots left out that are named one by one.
const LEFT_OUT_SHOWN: usize = 20;
/// gRPC's exit code for something that is not there.
const NOT_FOUND: u8 = 4;

/// What to write down.
#[derive(clap::Args)]
pub struct Create {
    #[command(flatten)]
    call: Call,
    /// Its id, never used before. Often the name and version of the bundle.
    rollout_id: String,
    /// The bundle, as NAME-VERSION or by its SHA-256. Without it the one that is called like the roll-out.
    #[arg(long)]
    bundle: Option<String>,
    /// Who comes when: numbers, percents, label:KEY=VALUE, version:VERSION, and rest at the end. Without it 1,25%,rest.
    #[arg(long, value_delimiter = ',', value_parser = wave)]
    waves: Vec<v1::RolloutWave>,
    /// Site time for which a wave is only watched. Without it 10m.
    #[arg(long, value_parser = crate::duration)]
    soak: Option<Duration>,
    /// Site time on probation, without work, after the switch. Without it 3m, or 10s on a server of `dev`.
    #[arg(long, value_parser = crate::duration)]
    probation: Option<Duration>,
    /// Site time that a robot may take to end its work. Without it 10m.
    #[arg(long, value_parser = crate::duration)]
    drain_within: Option<Duration>,
    /// Tasks that each robot of a wave must have ended on trial. Without it 2.
    #[arg(long)]
    exposure_tasks: Option<u64>,
    /// Site time after the soak until a person is asked about a wave with too few tasks. Without it 1h.
    #[arg(long, value_parser = crate::duration)]
    exposure_within: Option<Duration>,
    /// Robots out of work for it at once. Without it the wave; the area's rules hold beside it.
    #[arg(long)]
    max_in_flight: Option<u32>,
    /// Only robots in these areas.
    #[arg(long, value_delimiter = ',')]
    area: Vec<String>,
    /// Only these robots.
    #[arg(long, value_delimiter = ',')]
    robot: Vec<String>,
    /// Only robots with these labels, KEY=VALUE.
    #[arg(long, value_parser = pair)]
    label: Vec<(String, String)>,
    /// Only robots of these hardware models.
    #[arg(long, value_delimiter = ',')]
    model: Vec<String>,
    /// Only robots that run one of these versions.
    #[arg(long, value_delimiter = ',')]
    from_version: Vec<String>,
    /// What happens with a wave that is too small to prove anything. Without it auto.
    #[arg(long, value_enum)]
    small_wave: Option<SmallWave>,
    /// What a failure means while fewer than ten robots were attempted. Without it abort.
    #[arg(long, value_enum)]
    small_wave_failure: Option<SmallWaveFailure>,
    /// Who goes back at an abort. Without it all.
    #[arg(long, value_enum)]
    abort_scope: Option<AbortScope>,
    /// A large first wave, or a single one, is meant so. Where people sign in that needs the role ota-full-push too.
    #[arg(long)]
    allow_full_push: bool,
    /// Bytes a second that each robot may download, e.g. 5MiB. Without it as fast as it goes.
    #[arg(long, value_parser = rate)]
    rate: Option<u32>,
    /// A suspicion from rates of task failures ends it too. Without it that is only shown.
    #[arg(long)]
    acts_on_rates: bool,
    /// So many percent of the robots that were offered it must have it at the end, or its outcome is INCOMPLETE. Without it 90.
    #[arg(long, value_name = "PERCENT")]
    complete_percent: Option<u32>,
    /// Time after which a robot that is out of work for it and is not heard is lost, and somebody is told. Without it 15m.
    #[arg(long, value_parser = crate::duration)]
    lost_after: Option<Duration>,
    /// Lost robots count in no budget until they are heard. Without it somebody has to say so: rollout write-off.
    #[arg(long)]
    write_off_lost: bool,
    /// No component may have a lower rollback index than this: robots refuse it. Without it 0; each robot holds its own floor beside it.
    #[arg(long, default_value_t = 0)]
    rollback_floor: u64,
    /// A person judges a wave whose robots take so many percent longer for a task than the others. Without it that is only shown.
    #[arg(long, value_name = "PERCENT")]
    max_slower: Option<u32>,
    /// A person judges a wave whose robots need so many percent more energy for a kilometre than the others. Without it that is only shown.
    #[arg(long, value_name = "PERCENT")]
    max_energy: Option<u32>,
    /// A person judges a wave whose joints get so many degrees hotter than those of the others ever were. Without it that is only shown.
    #[arg(long, value_name = "DEGREES")]
    max_hotter: Option<u32>,
    /// Only tell what it would do now: whom it reaches, who is left out and why. Nothing is written.
    #[arg(long, conflicts_with_all = ["start", "supersede"])]
    dry_run: bool,
    /// Submit, approve and start it too.
    #[arg(long)]
    start: bool,
    /// With --start: abort roll-outs that have some of the robots first.
    #[arg(long, requires = "start")]
    supersede: bool,
}

/// What happens with a wave that shows nothing bad and proves nothing.
#[derive(Clone, Copy, ValueEnum)]
enum SmallWave {
    /// It goes on, and the verdict says that nothing was proven.
    Auto,
    /// A person judges it.
    Review,
}

/// What a failure among few means.
#[derive(Clone, Copy, ValueEnum)]
enum SmallWaveFailure {
    /// The roll-out is aborted.
    Abort,
    /// A person judges it.
    Review,
}

/// Who goes back.
#[derive(Clone, Copy, ValueEnum)]
enum AbortScope {
    /// Every robot that it touched.
    All,
    /// Only robots on trial; what was committed stays.
    Trial,
}

impl Create {
    /// What is asked for; what no flag says is left to the server.
    pub fn spec(&self) -> v1::RolloutSpec {
        let site = |time: Option<Duration>| time.and_then(|t| prost_types::Duration::try_from(t).ok());
        let selector = v1::RolloutSelector {
            robot_ids: self.robot.clone(),
            area_ids: self.area.clone(),
            labels: self.label.iter().cloned().collect(),
            models: self.model.clone(),
            versions: self.from_version.clone(),
        };
        v1::RolloutSpec {
            bundle: self.bundle.clone().unwrap_or_else(|| self.rollout_id.clone()),
            selector: (selector != v1::RolloutSelector::default()).then_some(selector),
            waves: self.waves.clone(),
            max_in_flight: self.max_in_flight,
            drain_within: site(self.drain_within),
            probation: site(self.probation),
            soak: site(self.soak),
            exposure_tasks: self.exposure_tasks,
            exposure_within: site(self.exposure_within),
            small_wave: self.small_wave.map_or(0, |s| match s {
                SmallWave::Auto => v1::SmallWave::Auto as i32,
                SmallWave::Review => v1::SmallWave::Review as i32,
            }),
            small_wave_failure: self.small_wave_failure.map_or(0, |s| match s {
                SmallWaveFailure::Abort => v1::SmallWaveFailure::Abort as i32,
                SmallWaveFailure::Review => v1::SmallWaveFailure::Review as i32,
            }),
            abort_scope: self.abort_scope.map_or(0, |s| match s {
                AbortScope::All => v1::AbortScope::All as i32,
                AbortScope::Trial => v1::AbortScope::Trial as i32,
            }),
            allow_full_push: self.allow_full_push,
            rate_bytes_s: self.rate.unwrap_or_default(),
            acts_on_rates: self.acts_on_rates,
            complete_percent: self.complete_percent,
            lost_after: site(self.lost_after),
            writes_off_lost: self.write_off_lost,
            rollback_floor: self.rollback_floor,
            effort: self.effort(),
        }
    }

    /// Limits of what work may cost more, if there are any.
    fn effort(&self) -> Option<v1::EffortLimits> {
        let tenths = |limit: Option<u32>| limit.map(|limit| limit.saturating_mul(10));
        let limits = v1::EffortLimits {
            slower_permille: tenths(self.max_slower),
            energy_permille: tenths(self.max_energy),
            hotter_decidegrees: tenths(self.max_hotter),
        };
        (limits != v1::EffortLimits::default()).then_some(limits)
    }

    /// A refusal, with what to try where the bundle was only guessed.
    fn refused(&self, status: tonic::Status) -> Exit {
        let exit = Exit::with_facts(status);
        if self.bundle.is_none() && exit.code() == NOT_FOUND {
            return exit.or_try("name one of them with --bundle");
        }
        exit
    }
}

/// Writes it down, or tells what it would do.
pub async fn run(args: Create, out: &Out) -> Result<(), Exit> {
    let mut client = args.call.rollouts().await?;
    let (rollout_id, spec) = (args.rollout_id.clone(), Some(args.spec()));
    if args.dry_run {
        let request = v1::PlanRolloutRequest { rollout_id, spec };
        let plan = client.plan_rollout(unary(request)).await.map_err(|s| args.refused(s))?.into_inner();
        out.one(&plan, &args.rollout_id, || describe_plan(&args.rollout_id, &args.spec().waves, &plan))?;
        out.inform("a dry run: nothing was written");
        out.next("the same without --dry-run writes it down, with --start it begins");
        return Ok(());
    }
    let request = v1::CreateRolloutRequest { rollout_id, spec };
    let answer = client.create_rollout(unary(request)).await.map_err(|s| args.refused(s))?.into_inner();
    let mut rollout = answer.rollout.unwrap_or_default();
    if args.start {
        rollout = begin(&mut client, &args.rollout_id, args.supersede, out).await?;
    }
    show(&rollout, out)
}

/// Describes a plan in words.
pub fn describe_plan(rollout_id: &str, waves: &[v1::RolloutWave], plan: &v1::PlanRolloutResponse) -> String {
    let all: u32 = plan.wave_sizes.iter().sum();
    let count = plan.wave_sizes.len() as u32;
    let mut lines = vec![format!("{rollout_id} would reach {}", text::robots(all))];
    for (ix, size) in (0..).zip(&plan.wave_sizes) {
        let of = waves.get(ix as usize).map(|w| format!("  ({})", text::size(w))).unwrap_or_default();
        lines.push(format!("  {}: {}{of}", text::wave(ix, count), text::robots(*size)));
    }
    let reasons = plan.left_out_by_reason.iter().map(|(code, n)| format!("{n} {code}")).collect::<Vec<_>>();
    if !reasons.is_empty() {
        lines.push(format!("  left out: {}", reasons.join(", ")));
    }
    for left in plan.left_out.iter().take(LEFT_OUT_SHOWN) {
        let why = left.reason.as_ref().map(text::reason).unwrap_or_default();
        lines.push(format!("    {}  {why}", left.robot_id));
    }
    let more = plan.left_out.len().saturating_sub(LEFT_OUT_SHOWN);
    if more > 0 {
        lines.push(format!("    and {more} more; all of them with -o json"));
    }
    let least = plan.least.as_ref().map(span).unwrap_or_default();
    lines.push(format!("  each robot fetches at most {} bytes; it takes {least} of site time at least", plan.bytes));
    lines.extend(plan.caveats.iter().map(|caveat| format!("  mind: {caveat}")));
    let kinds: Vec<Vec<String>> = plan.strata.iter().map(kind).collect();
    if !kinds.is_empty() {
        lines.push(columns(&["MODEL", "RUNS", "AREA", "CAN", "ROBOTS", "IN WAVE 1"], &kinds));
    }
    lines.join("\n")
}

fn kind(s: &v1::RolloutStratum) -> Vec<String> {
    let or_dash = |text: &str| if text.is_empty() { "-".to_owned() } else { text.to_owned() };
    let first = if s.in_first_wave { "yes" } else { "no" };
    vec![
        or_dash(&s.model),
        or_dash(&s.from_version),
        or_dash(&s.area_id),
        or_dash(&s.capabilities.join(" ")),
        s.robots.to_string(),
        first.to_owned(),
    ]
}
