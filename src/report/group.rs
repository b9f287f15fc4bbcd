//! Runs of one world and eta, measured and bootstrapped: what the tables are computed from.

use super::runs::{Regret, Run, Runs};
use super::statistics::{self, Estimate};
use crate::experiment::archive::FIRST_METHOD;
use crate::experiment::artefacts::Chance;
use crate::game::returns::ReturnLaw;
use crate::learn::policy::Mode;
use lava_envs::End;
use lava_envs::random::{self, ChaCha8Rng, Purpose};
use rand_distr::{Distribution as _, StandardNormal};

/// The risk levels of the cross matrix.
pub const ALPHAS: [f64; 7] = [1.0, 0.5, 0.25, 0.1, 0.05, 0.04, 0.01];

/// Bootstrap replicates: the noise they leave in an end of an interval is about a twentieth of its
/// width.
const REPLICATES: usize = 2000;

/// What is measured of one run, or of its redrawn episodes. `None` where it does not exist.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Measures {
    /// Set of a failed run without evaluation: all else is `None`.
    pub absent: bool,
    /// `E[J]` of the greedy protagonist under nominal chance.
    pub mean: Option<f64>,
    /// Its CVaR at every alpha of [`Group::alphas`].
    pub cvar: Vec<Option<f64>>,
    /// Its lava rate.
    pub lava: Option<f64>,
    /// Its goal rate.
    pub goal: Option<f64>,
    /// Its timeout rate.
    pub timeout: Option<f64>,
    /// Mean steps of its episodes that reach the goal.
    pub steps_to_goal: Option<f64>,
    /// Its mean least distance to lava.
    pub clearance: Option<f64>,
    /// `E[J]` of the sampled protagonist under nominal chance.
    pub sampled_mean: Option<f64>,
    /// CVaR_{1/eta} of the sampled protagonist under nominal chance.
    pub sampled_cvar: Option<f64>,
    /// `E[J]` of the sampled protagonist under its antagonist.
    pub game_value: Option<f64>,
    /// `game_value - sampled_cvar`.
    pub bound_slack: Option<f64>,
    /// `E[J]` of the greedy protagonist under its antagonist.
    pub greedy_game_value: Option<f64>,
    /// V*(eta) - CVaR_{1/eta}.
    pub regret: Option<f64>,
    /// Greedy game value - CVaR_{1/eta}.
    pub antagonist_gap: Option<f64>,
    /// CVaR_{1/eta} of the best stationary policy found - CVaR_{1/eta}; exact.
    pub class_regret: Option<f64>,
    /// Best response to the antagonist - V*(eta); exact.
    pub response_gain: Option<f64>,
    /// The larger one of the regret and the response gain.
    pub exploitability: Option<f64>,
}

/// The four laws of the return that a run is measured by.
struct Laws {
    greedy: Option<ReturnLaw>,
    sampled: Option<ReturnLaw>,
    game: Option<ReturnLaw>,
    greedy_game: Option<ReturnLaw>,
}

impl Laws {
    fn of(run: &Run, mut take: impl FnMut(&ReturnLaw) -> ReturnLaw) -> Laws {
        let greedy = run.law(Mode::Greedy, Chance::Nominal).map(&mut take);
        let sampled = run.law(Mode::Sampled, Chance::Nominal).map(&mut take);
        // At eta = 1 the game is the nominal play: the same episodes, not others like them.
        let (game, greedy_game) = if run.name.eta == 1.0 {
            (sampled.clone(), greedy.clone())
        } else {
            (run.game_law(Mode::Sampled).map(&mut take), run.game_law(Mode::Greedy).map(&mut take))
        };
        Laws { greedy, sampled, game, greedy_game }
    }
}

impl Measures {
    fn of(run: &Run, alphas: &[f64]) -> Measures {
        let laws = Laws::of(run, ReturnLaw::clone);
        let certificate = run.evaluation.as_ref().and_then(|evaluation| evaluation.certificate);
        // Without an antagonist there is no gap, though files have a 0.
        let gap = certificate.filter(|_| laws.greedy_game.is_some()).map(|of| of.antagonist_gap);
        let regret = run.regret.known().map(|(regret, _)| regret);
        let cvar = statistics::cvar;
        Measures::new(run, &laws, alphas, regret, gap, cvar)
    }

    /// The same of redrawn episodes. Certificates come as numbers, whose standard errors stand for
    /// their episodes.
    fn redrawn(run: &Run, found: &Measures, alphas: &[f64], random: &mut ChaCha8Rng) -> Measures {
        let laws = Laws::of(run, |law| statistics::redraw(law, random));
        let certificate = run.evaluation.as_ref().and_then(|evaluation| evaluation.certificate);
        let mut noisy = |number: f64, standard_error: f64| {
            let noise: f64 = StandardNormal.sample(random);
            number + noise * standard_error
        };
        let gap = found
            .antagonist_gap
            .and(certificate)
            .map(|of| noisy(of.antagonist_gap, of.antagonist_gap_standard_error));
        let regret = match run.regret {
            // The redrawn episodes have it.
            Regret::Known { best: Some(best), .. } => {
                laws.greedy.as_ref().map(|law| best - law.cvar(run.alpha()))
            }
            Regret::Known { value, standard_error, .. } => Some(noisy(value, standard_error)),
            _ => None,
        };
        let mut measures =
            Measures::new(run, &laws, alphas, regret, gap, |law, alpha| Some(law.cvar(alpha)));
        // A redrawn law counts no episodes; what the original refuses stays refused.
        for (redrawn, found) in measures.cvar.iter_mut().zip(&found.cvar) {
            *redrawn = found.and(*redrawn);
        }
        measures.sampled_cvar = found.sampled_cvar.and(measures.sampled_cvar);
        measures.bound_slack = found.bound_slack.and(measures.bound_slack);
        measures
    }

    fn new(
        run: &Run,
        laws: &Laws,
        alphas: &[f64],
        regret: Option<f64>,
        antagonist_gap: Option<f64>,
        cvar: impl Fn(&ReturnLaw, f64) -> Option<f64>,
    ) -> Measures {
        let greedy = laws.greedy.as_ref();
        let rate = |end| greedy.map(|law| law.probability(end));
        let sampled_cvar = laws.sampled.as_ref().and_then(|law| cvar(law, run.alpha()));
        let game_value = laws.game.as_ref().map(ReturnLaw::mean);
        let certificate = run.evaluation.as_ref().and_then(|evaluation| evaluation.certificate);
        let exploitability = certificate.and_then(|of| of.exploitability);
        Measures {
            absent: run.evaluation.is_none(),
            mean: greedy.map(ReturnLaw::mean),
            cvar: alphas.iter().map(|&alpha| greedy.and_then(|law| cvar(law, alpha))).collect(),
            lava: rate(End::Lava),
            goal: rate(End::Goal),
            timeout: rate(End::Timeout),
            steps_to_goal: greedy.and_then(ReturnLaw::steps_to_goal),
            clearance: run.clearance(),
            sampled_mean: laws.sampled.as_ref().map(ReturnLaw::mean),
            sampled_cvar,
            game_value,
            bound_slack: game_value.zip(sampled_cvar).map(|(value, cvar)| value - cvar),
            greedy_game_value: laws.greedy_game.as_ref().map(ReturnLaw::mean),
            regret,
            antagonist_gap,
            class_regret: certificate.and_then(|of| of.class_regret),
            response_gain: exploitability.map(|of| of.response_gain),
            exploitability: exploitability.map(|of| of.epsilon),
        }
    }
}

/// All seeds of one world and eta, of one method and variant.
pub struct Group<'a> {
    /// What its rows and panels are called: `METHOD[/VARIANT]`, or only `VARIANT` in a folder where all runs are
    /// of the method `game`, and what tells its settings apart; `None` where all this is the same.
    pub method: Option<String>,
    /// Name of the world.
    pub env: &'a str,
    /// Budget eta.
    pub eta: f64,
    /// Its runs, by seed.
    pub runs: &'a [Run],
    /// The levels at which CVaR is measured, descending: [`ALPHAS`] and 1/eta of every eta of the
    /// world.
    pub alphas: Vec<f64>,
    /// Of every run.
    pub measures: Vec<Measures>,
    /// Of every bootstrap replicate, of every run drawn.
    replicates: Vec<Vec<Measures>>,
}

/// The runs, measured and bootstrapped, by method and variant, world and eta.
pub fn groups(runs: &Runs) -> Vec<Group<'_>> {
    let one_method = runs.runs.iter().all(|run| run.name.method == FIRST_METHOD);
    let method = |run: &Run| {
        let name = match &run.name.variant {
            _ if runs.are_plain() => return None,
            Some(variant) if one_method => variant.clone(),
            _ => run.name.label(),
        };
        Some(run.label.as_ref().map_or(name.clone(), |label| format!("{name}, {label}")))
    };
    let same = |a: &Run, b: &Run| {
        if a.label != b.label {
            return false;
        }
        let (a, b) = (&a.name, &b.name);
        (&a.method, &a.variant, &a.world, a.eta) == (&b.method, &b.variant, &b.world, b.eta)
    };
    let alphas = |of: &[Run]| {
        let world = runs.runs.iter().filter(|run| run.name.world == of[0].name.world);
        let mut alphas: Vec<f64> = ALPHAS.into_iter().chain(world.map(Run::alpha)).collect();
        alphas.sort_by(|a, b| b.total_cmp(a));
        alphas.dedup();
        alphas
    };
    (runs.runs.chunk_by(same)).map(|of| Group::new(method(&of[0]), of, alphas(of))).collect()
}

/// The policies that the runs can be compared with, each a group of one.
pub fn references(runs: &Runs) -> Vec<Group<'_>> {
    let alphas = |of: &Run| ALPHAS.into_iter().chain([of.alpha()]).collect();
    let name = |of: &Run| Some(of.name.method.clone());
    (runs.references.chunks(1)).map(|of| Group::new(name(&of[0]), of, alphas(&of[0]))).collect()
}

impl<'a> Group<'a> {
    fn new(method: Option<String>, runs: &'a [Run], alphas: Vec<f64>) -> Self {
        let (env, eta) = (runs[0].name.world.as_str(), runs[0].name.eta);
        let measures: Vec<Measures> = runs.iter().map(|run| Measures::of(run, &alphas)).collect();
        // The stream belongs to the world and eta: intervals do not move when other rows are added, and
        // methods are redrawn alike.
        let index = fnv(&format!("{env}/eta-{eta}")) & ((1 << 56) - 1);
        let mut random = random::stream(0, Purpose::Bootstrap, index);
        let seeds: Vec<(&Run, &Measures)> = runs.iter().zip(&measures).collect();
        let replicates = statistics::nested_bootstrap(
            &seeds,
            REPLICATES,
            &mut random,
            |(run, found), random| Measures::redrawn(run, found, &alphas, random),
        );
        Group { method, env, eta, runs, alphas, measures, replicates }
    }

    /// The heading of its panels: `eta = 25`, after its method where there are several.
    pub fn title(&self) -> String {
        let method = self.method.as_ref().map_or(String::new(), |method| format!("{method}, "));
        format!("{method}eta = {}", self.eta)
    }

    /// Number of runs that failed.
    pub fn failures(&self) -> usize {
        self.runs.iter().filter(|run| run.failure.is_some()).count()
    }

    /// Risk level alpha = 1/eta.
    pub fn alpha(&self) -> f64 {
        1.0 / self.eta
    }

    /// The place of a level in [`Measures::cvar`].
    ///
    /// # Panics
    /// If the level is not one of [`Group::alphas`].
    pub fn level(&self, alpha: f64) -> usize {
        let place = self.alphas.iter().position(|&level| level == alpha);
        place.expect("every alpha of the world is measured")
    }

    /// Mean over the runs that have the measure, with the nested bootstrap's interval.
    pub fn mean(&self, measure: impl Fn(&Measures) -> Option<f64>) -> Option<Estimate> {
        self.estimate(|measures| {
            statistics::mean(&measures.iter().filter_map(&measure).collect::<Vec<f64>>())
        })
    }

    /// Interquartile mean over all runs.
    pub fn iqm(&self, measure: impl Fn(&Measures) -> Option<f64>) -> Option<Estimate> {
        self.estimate(|measures| statistics::iqm(&ranked(measures, &measure)?))
    }

    /// A rate over all episodes of all runs. Where Wilson's interval of as many recorded episodes is
    /// wider than the bootstrap's, as it is for what never happened, it widens it.
    pub fn rate(&self, measure: impl Fn(&Measures) -> Option<f64>) -> Option<Estimate> {
        let mut estimate = self.mean(&measure)?;
        let (mut successes, mut trials) = (0.0, 0.0);
        for (run, measures) in self.runs.iter().zip(&self.measures) {
            let law = run.law(Mode::Greedy, Chance::Nominal);
            if let Some((episodes, rate)) = law.and_then(ReturnLaw::episodes).zip(measure(measures))
            {
                successes += rate * episodes as f64;
                trials += episodes as f64;
            }
        }
        if let (Some(interval), Some(wilson)) =
            (&mut estimate.interval, statistics::wilson(successes, trials))
        {
            interval.low = interval.low.min(wilson.low);
            interval.high = interval.high.max(wilson.high);
        }
        Some(estimate)
    }

    /// The worst run by a measure and its seed; a failed one is worse than any number, and then the
    /// value is minus infinity.
    pub fn worst(&self, measure: impl Fn(&Measures) -> Option<f64>) -> Option<(u64, f64)> {
        let scores = ranked(&self.measures, &measure)?;
        let worst = statistics::worst(&scores)?;
        let place = scores.iter().position(|&score| score == worst)?;
        Some((self.runs[place].name.seed, worst))
    }

    /// CVaR at this group's alpha minus the same of `baseline`, over the seeds that both have.
    /// The number of these pairs comes with it.
    pub fn difference(&self, baseline: &Group) -> Option<(Estimate, usize)> {
        let (own, other) = (self.level(self.alpha()), baseline.level(self.alpha()));
        let differences: Vec<f64> = (self.runs.iter().zip(&self.measures))
            .filter_map(|(run, measures)| {
                let twin = baseline.runs.iter().position(|twin| twin.name.seed == run.name.seed)?;
                let score = measures.cvar[own]?;
                Some(score - baseline.measures[twin].cvar[other]?)
            })
            .collect();
        Some((statistics::paired_difference(&differences)?, differences.len()))
    }

    /// CVaR at this group's alpha minus that of a policy which is not one of several seeds, mean over the runs.
    pub fn above(&self, reference: &Group) -> Option<Estimate> {
        let own = self.level(self.alpha());
        let known = reference.cvar_at(self.alpha())?;
        self.mean(|measures| Some(measures.cvar[own]? - known))
    }

    /// Share of the runs whose CVaR at this group's alpha is above that of such a policy; a failed run's is not.
    pub fn share_above(&self, reference: &Group) -> Option<Estimate> {
        let own = self.level(self.alpha());
        let known = reference.cvar_at(self.alpha())?;
        self.estimate(|measures| {
            let scores = ranked(measures, &|measures| measures.cvar[own])?;
            let better: Vec<f64> =
                scores.iter().map(|&of| f64::from(u8::from(of > known))).collect();
            statistics::mean(&better)
        })
    }

    /// CVaR at one of its levels, of a group of one run.
    fn cvar_at(&self, alpha: f64) -> Option<f64> {
        let place = self.alphas.iter().position(|&level| level == alpha)?;
        self.measures.first()?.cvar[place]
    }

    /// Probability that a run of this group has a better CVaR at this group's alpha than a run of
    /// `baseline`; a failed run loses against all but another failed one.
    pub fn improvement(&self, baseline: &Group) -> Option<Estimate> {
        let (own, other) = (self.level(self.alpha()), baseline.level(self.alpha()));
        let compare = |x: &[Measures], y: &[Measures]| {
            let x = ranked(x, &|measures| measures.cvar[own])?;
            let y = ranked(y, &|measures| measures.cvar[other])?;
            statistics::improvement(&x, &y)
        };
        let value = compare(&self.measures, &baseline.measures)?;
        let replicates: Vec<f64> = (self.replicates.iter().zip(&baseline.replicates))
            .filter_map(|(x, y)| compare(x, y))
            .collect();
        let enough = self.runs.len() > 1 && baseline.runs.len() > 1;
        let interval = statistics::percentile_interval(&replicates).filter(|_| enough);
        Some(Estimate { value, interval })
    }

    fn estimate(&self, statistic: impl Fn(&[Measures]) -> Option<f64>) -> Option<Estimate> {
        let value = statistic(&self.measures)?;
        let replicates: Vec<f64> =
            self.replicates.iter().filter_map(|replicate| statistic(replicate)).collect();
        // One seed says nothing about the spread between seeds: its episodes alone would make an
        // interval that is far too narrow.
        let enough = self.measures.iter().filter(|measures| !measures.absent).count() > 1;
        let interval = statistics::percentile_interval(&replicates).filter(|_| enough);
        Some(Estimate { value, interval })
    }
}

/// Scores for statistics that rank: a failed run is minus infinity. `None` if a run that did not fail
/// has no score.
fn ranked(measures: &[Measures], measure: &impl Fn(&Measures) -> Option<f64>) -> Option<Vec<f64>> {
    let score = |of: &Measures| if of.absent { Some(f64::NEG_INFINITY) } else { measure(of) };
    measures.iter().map(score).collect()
}

/// The FNV-1a hash: one number for a name, the same on every machine and in every version.
fn fnv(name: &str) -> u64 {
    name.bytes().fold(0xcbf2_9ce4_8422_2325, |hash, byte| {
        (hash ^ u64::from(byte)).wrapping_mul(0x100_0000_01b3)
    })
}
