//! Runs of one world and eta, measured: what the tables are computed from.

use super::runs::{Run, Runs};
use super::statistics::{self, Estimate, Interval};
use crate::experiment::archive::FIRST_METHOD;
use crate::experiment::artefacts::Chance;
use crate::game::returns::{NORMAL_95, ReturnLaw};
use crate::learn::policy::Mode;
use lava_envs::End;

/// The risk levels of the cross matrix.
pub const ALPHAS: [f64; 7] = [1.0, 0.5, 0.25, 0.1, 0.05, 0.04, 0.01];

/// What is measured of one run. `None` where it does not exist.
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
struct Laws<'a> {
    greedy: Option<&'a ReturnLaw>,
    sampled: Option<&'a ReturnLaw>,
    game: Option<&'a ReturnLaw>,
    greedy_game: Option<&'a ReturnLaw>,
}

impl Laws<'_> {
    fn of(run: &Run) -> Laws<'_> {
        Laws {
            greedy: run.law(Mode::Greedy, Chance::Nominal),
            sampled: run.law(Mode::Sampled, Chance::Nominal),
            game: run.game_law(Mode::Sampled),
            greedy_game: run.game_law(Mode::Greedy),
        }
    }
}

impl Measures {
    fn of(run: &Run, alphas: &[f64]) -> Measures {
        let laws = Laws::of(run);
        let greedy = laws.greedy;
        let rate = |end| greedy.map(|law| law.probability(end));
        let cvar =
            |law: Option<&ReturnLaw>, alpha| law.and_then(|law| statistics::cvar(law, alpha));
        let sampled_cvar = cvar(laws.sampled, run.alpha());
        let game_value = laws.game.map(ReturnLaw::mean);
        let certificate = run.evaluation.as_ref().and_then(|evaluation| evaluation.certificate);
        // Without an antagonist there is no gap, though files have a 0.
        let gap = certificate.filter(|_| laws.greedy_game.is_some()).map(|of| of.antagonist_gap);
        let exploitability = certificate.and_then(|of| of.exploitability);
        Measures {
            absent: run.evaluation.is_none(),
            mean: greedy.map(ReturnLaw::mean),
            cvar: alphas.iter().map(|&alpha| cvar(greedy, alpha)).collect(),
            lava: rate(End::Lava),
            goal: rate(End::Goal),
            timeout: rate(End::Timeout),
            steps_to_goal: greedy.and_then(ReturnLaw::steps_to_goal),
            clearance: run.clearance(),
            sampled_mean: laws.sampled.map(ReturnLaw::mean),
            sampled_cvar,
            game_value,
            bound_slack: game_value.zip(sampled_cvar).map(|(value, cvar)| value - cvar),
            greedy_game_value: laws.greedy_game.map(ReturnLaw::mean),
            regret: run.regret.known().map(|(regret, _)| regret),
            antagonist_gap: gap,
            class_regret: certificate.and_then(|of| of.class_regret),
            response_gain: exploitability.map(|of| of.response_gain),
            exploitability: exploitability.map(|of| of.epsilon),
        }
    }

    /// The standard errors that the episodes of the run leave in its measures; `None` where there is no such error.
    fn errors(run: &Run, alphas: &[f64]) -> Measures {
        let laws = Laws::of(run);
        let mean = |law: Option<&ReturnLaw>| law.map(ReturnLaw::mean_standard_error);
        let cvar = |law: Option<&ReturnLaw>, alpha| law.map(|law| law.cvar_standard_error(alpha));
        let rate = |end| {
            let (rate, episodes) = (laws.greedy?.probability(end), laws.greedy?.episodes()?);
            Some((rate * (1.0 - rate) / episodes as f64).sqrt())
        };
        let (game_value, sampled_cvar) = (mean(laws.game), cvar(laws.sampled, run.alpha()));
        let certificate = run.evaluation.as_ref().and_then(|evaluation| evaluation.certificate);
        Measures {
            mean: mean(laws.greedy),
            cvar: alphas.iter().map(|&alpha| cvar(laws.greedy, alpha)).collect(),
            lava: rate(End::Lava),
            goal: rate(End::Goal),
            timeout: rate(End::Timeout),
            sampled_mean: mean(laws.sampled),
            sampled_cvar,
            game_value,
            bound_slack: game_value.zip(sampled_cvar).map(|(value, cvar)| value.hypot(cvar)),
            greedy_game_value: mean(laws.greedy_game),
            regret: run.regret.known().map(|(_, error)| error),
            antagonist_gap: certificate.map(|of| of.antagonist_gap_standard_error),
            ..Measures::default()
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
    /// Their standard errors.
    errors: Vec<Measures>,
}

/// The runs, measured, by method and variant, world and eta.
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
        let measures = runs.iter().map(|run| Measures::of(run, &alphas)).collect();
        let errors = runs.iter().map(|run| Measures::errors(run, &alphas)).collect();
        Group { method, env, eta, runs, alphas, measures, errors }
    }

    /// The heading of its panels: `eta = 25`, after its method where there are several.
    pub fn title(&self) -> String {
        let method = self.method.as_ref().map_or(String::new(), |method| format!("{method}, "));
        format!("{method}eta = {}", self.eta)
    }

    /// Number of runs that failed ([`Run::failed`]).
    pub fn failures(&self) -> usize {
        self.runs.iter().filter(|run| run.failed).count()
    }

    /// The share of runs that failed.
    pub fn failure_rate(&self) -> Option<Estimate> {
        share(self.failures(), self.runs.len())
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

    /// The places of the runs that the statistics are of: those that did not fail or, where all failed, all.
    fn counted(&self) -> impl Iterator<Item = usize> {
        let all_failed = self.failures() == self.runs.len();
        (0..self.runs.len()).filter(move |&place| all_failed || !self.runs[place].failed)
    }

    /// The measure of the runs that are counted, and the sampling error of one of them (root mean square).
    fn sample(&self, measure: &impl Fn(&Measures) -> Option<f64>) -> (Vec<f64>, f64) {
        let found = |place: usize| Some((measure(&self.measures[place])?, place));
        let found: Vec<(f64, usize)> = self.counted().filter_map(found).collect();
        let squares: Vec<f64> = (found.iter())
            .map(|&(_, place)| measure(&self.errors[place]).unwrap_or_default().powi(2))
            .collect();
        let error = statistics::mean(&squares).unwrap_or_default().sqrt();
        (found.into_iter().map(|(value, _)| value).collect(), error)
    }

    /// Mean over the runs that did not fail and have the measure.
    pub fn mean(&self, measure: impl Fn(&Measures) -> Option<f64>) -> Option<Estimate> {
        let (values, error) = self.sample(&measure);
        statistics::mean_estimate(&values, error)
    }

    /// CVaR at a level over all runs, failed ones too; `None` where the range of returns is not known.
    pub fn overall(&self, alpha: f64) -> Option<Estimate> {
        let level = self.level(alpha);
        let range = self.runs[0].returns?;
        let (mut succeeded, mut failed) = (Vec::new(), Vec::new());
        for (run, measures) in self.runs.iter().zip(&self.measures) {
            if run.failed {
                failed.push(measures.cvar[level]);
            } else {
                succeeded.push(measures.cvar[level]?);
            }
        }
        let (_, error) = self.sample(&|measures| measures.cvar[level]);
        statistics::overall(&succeeded, &failed, range, error)
    }

    /// Interquartile mean over all runs, failed ones too.
    pub fn iqm(&self, measure: impl Fn(&Measures) -> Option<f64>) -> Option<Estimate> {
        let (_, error) = self.sample(&measure);
        statistics::iqm_estimate(&ranked(&self.measures, &measure)?, error)
    }

    /// A rate: its mean. Where Wilson's interval of as many recorded episodes is wider than that of the mean, as it is
    /// for what never happened, it widens it.
    pub fn rate(&self, measure: impl Fn(&Measures) -> Option<f64>) -> Option<Estimate> {
        let mut estimate = self.mean(&measure)?;
        let (mut successes, mut trials) = (0.0, 0.0);
        for place in self.counted() {
            let law = self.runs[place].law(Mode::Greedy, Chance::Nominal);
            if let Some((episodes, rate)) =
                law.and_then(ReturnLaw::episodes).zip(measure(&self.measures[place]))
            {
                successes += rate * episodes as f64;
                trials += episodes as f64;
            }
        }
        if let Some(interval) = &mut estimate.interval {
            let wilson = statistics::wilson(successes, trials).unwrap_or(*interval);
            interval.low = interval.low.min(wilson.low).max(0.0);
            interval.high = interval.high.max(wilson.high).min(1.0);
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

    /// CVaR at this group's alpha minus the same of `baseline`, of the seeds at which neither failed.
    pub fn differences(&self, baseline: &Group) -> Vec<f64> {
        let (own, other) = (self.level(self.alpha()), baseline.level(self.alpha()));
        let difference = |place: usize| {
            let seed = self.runs[place].name.seed;
            let twin = baseline.runs.iter().position(|twin| twin.name.seed == seed)?;
            if self.runs[place].failed || baseline.runs[twin].failed {
                return None;
            }
            Some(self.measures[place].cvar[own]? - baseline.measures[twin].cvar[other]?)
        };
        (0..self.runs.len()).filter_map(difference).collect()
    }

    /// The same over all runs of either, failed ones too, which are not paired.
    pub fn overall_difference(&self, baseline: &Group) -> Option<Estimate> {
        let alpha = self.alpha();
        Some(statistics::difference(self.overall(alpha)?, baseline.overall(alpha)?))
    }

    /// CVaR at this group's alpha minus that of a policy which is not one of several seeds, mean over the runs that did
    /// not fail.
    pub fn above(&self, reference: &Group) -> Option<Estimate> {
        let own = self.level(self.alpha());
        let (known, of_known) = reference.cvar_at(self.alpha())?;
        let (values, error) = self.sample(&|measures| measures.cvar[own]);
        let differences: Vec<f64> = values.iter().map(|value| value - known).collect();
        statistics::mean_estimate(&differences, error.hypot(of_known))
    }

    /// The same over all runs.
    pub fn overall_above(&self, reference: &Group) -> Option<Estimate> {
        let (known, error) = reference.cvar_at(self.alpha())?;
        let half = NORMAL_95 * error;
        let interval = Some(Interval { low: known - half, high: known + half });
        let known = Estimate { value: known, interval };
        Some(statistics::difference(self.overall(self.alpha())?, known))
    }

    /// Share of the runs whose CVaR at this group's alpha is above that of such a policy; a failed run's is not.
    pub fn share_above(&self, reference: &Group) -> Option<Estimate> {
        let own = self.level(self.alpha());
        let (known, _) = reference.cvar_at(self.alpha())?;
        let scores = ranked(&self.measures, &|measures| measures.cvar[own])?;
        let above = |(run, score): (&Run, &f64)| !run.failed && *score > known;
        let better = self.runs.iter().zip(&scores).filter(|&of| above(of)).count();
        share(better, self.runs.len())
    }

    /// CVaR at one of its levels and its standard error, of a group of one run.
    fn cvar_at(&self, alpha: f64) -> Option<(f64, f64)> {
        let place = self.alphas.iter().position(|&level| level == alpha)?;
        let (value, error) = (self.measures[0].cvar[place]?, self.errors[0].cvar[place]);
        Some((value, error.unwrap_or_default()))
    }

    /// Probability that a run of this group has a better CVaR at this group's alpha than a run of
    /// `baseline`; a failed run without returns loses against all but another one.
    pub fn improvement(&self, baseline: &Group) -> Option<Estimate> {
        let (own, other) = (self.level(self.alpha()), baseline.level(self.alpha()));
        let x = ranked(&self.measures, &|measures| measures.cvar[own])?;
        let y = ranked(&baseline.measures, &|measures| measures.cvar[other])?;
        let value = statistics::improvement(&x, &y)?;
        let interval = statistics::improvement_interval(value, x.len(), y.len());
        Some(Estimate { value, interval })
    }
}

/// A share of runs; of one run there is no interval.
fn share(count: usize, all: usize) -> Option<Estimate> {
    let interval = statistics::clopper_pearson(count, all).filter(|_| all > 1);
    (all > 0).then(|| Estimate { value: count as f64 / all as f64, interval })
}

/// Scores for statistics that rank: a failed run is minus infinity. `None` if a run that did not fail
/// has no score.
fn ranked(measures: &[Measures], measure: &impl Fn(&Measures) -> Option<f64>) -> Option<Vec<f64>> {
    let score = |of: &Measures| if of.absent { Some(f64::NEG_INFINITY) } else { measure(of) };
    measures.iter().map(score).collect()
}
