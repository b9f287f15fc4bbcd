//! The antagonist of the game: a PPO player whose policy IS the perturbed law of chance, with any family
//! of perturbations that fits the law.
//!
//! The families of each law are listed once, in its [`Perturbed`] implementation below: a new
//! family is one file in `game` and one line here. The rest of the program uses an antagonist through
//! [`Antagonist`], whatever its family.

use super::budget_sensitivity::{BudgetSensitivity, STEP};
use super::device::Device;
use super::gae::Estimates;
use super::head::{AntagonistHead, Head};
use super::inputs::{Columns, Inputs};
use super::network::Network;
use super::options::{FamilyOptions, PlayerOptions};
use super::policy::{Draw, Streams};
use super::ppo::{Losses, Player, Rates, Signal};
use super::state::{PlayerState, Unfit};
use super::trajectories::Trajectories;
use crate::game::budget::Budget;
use crate::game::bump::Bump;
use crate::game::columns::SAMPLES;
use crate::game::finite::FiniteFamily;
use crate::game::gaussian::GaussianFamily;
use crate::game::perturbation::{Draws, Family, Perturbation};
use crate::game::probit::Probit;
use crate::game::shift::Shift;
use lava_envs::random::ChaCha8Rng;
use lava_envs::{FiniteLaw, GaussianLaw, Law};
use rand::RngExt;
use rand_distr::StandardNormal;
use smallvec::SmallVec;
use std::fmt::Debug;

/// What an antagonist records: the nominal law and the budget it acted within, and the outcome.
pub type Played<L> = Trajectories<(L, Budget), <L as Law>::Outcome>;

/// A law of chance that an antagonist can reweight.
pub trait Perturbed: Law {
    /// The families that fit this law, the default first.
    const FAMILIES: &'static [FamilyEntry<Self>];
}

impl<const N: usize> Perturbed for FiniteLaw<N> {
    const FAMILIES: &'static [FamilyEntry<Self>] = &[FamilyEntry::of::<FiniteFamily<N>>()];
}

impl Perturbed for GaussianLaw {
    const FAMILIES: &'static [FamilyEntry<Self>] = &[
        FamilyEntry::of::<GaussianFamily<Bump>>(),
        FamilyEntry::of::<GaussianFamily<Probit>>(),
        FamilyEntry::of::<Shift>(),
    ];
}

/// A family that can be chosen by its name.
#[derive(Debug)]
pub struct FamilyEntry<L: Law> {
    /// `train.family.kind`.
    pub kind: &'static str,
    within_budget: bool,
    antagonist: fn(&FamilyOptions, Sizes<'_>) -> Box<dyn Antagonist<L>>,
}

/// The options for a law that is not the world's law of chance: they stay, and its default family takes
/// the place of one that does not fit it.
pub fn fitting<L: Perturbed>(options: &FamilyOptions) -> FamilyOptions {
    let kind = if family::<L>(options).is_ok() { options.kind.clone() } else { "auto".to_owned() };
    FamilyOptions { kind, ..options.clone() }
}

/// How large an antagonist's networks are, and where they are.
struct Sizes<'a> {
    columns: Columns,
    hidden: usize,
    device: Device,
    random: &'a mut ChaCha8Rng,
}

/// A family that the options can select.
pub trait Named: Family + 'static {
    /// `train.family.kind`.
    const KIND: &'static str;

    /// Whether its likelihood ratios are within a budget. One without can only be bounded in every step, in a sense of
    /// its own.
    const WITHIN_BUDGET: bool = true;

    /// The family with these options.
    fn with(options: &FamilyOptions) -> Self;
}

impl<const N: usize> Named for FiniteFamily<N> {
    const KIND: &'static str = "softmax";

    fn with(_: &FamilyOptions) -> Self {
        FiniteFamily
    }
}

impl Named for GaussianFamily<Bump> {
    const KIND: &'static str = "bumps";

    fn with(options: &FamilyOptions) -> Self {
        gaussian(options)
    }
}

impl Named for GaussianFamily<Probit> {
    const KIND: &'static str = "probits";

    fn with(options: &FamilyOptions) -> Self {
        gaussian(options)
    }
}

impl Named for Shift {
    const KIND: &'static str = "shift";
    const WITHIN_BUDGET: bool = false;

    fn with(_: &FamilyOptions) -> Self {
        Shift
    }
}

fn gaussian<C>(options: &FamilyOptions) -> GaussianFamily<C> {
    GaussianFamily::new(options.count, options.center, options.curvature)
}

impl<L: Law> FamilyEntry<L> {
    const fn of<F: Named<Law = L>>() -> Self {
        FamilyEntry {
            kind: F::KIND,
            within_budget: F::WITHIN_BUDGET,
            antagonist: |options, Sizes { columns, hidden, device, random }| {
                let head = AntagonistHead(F::with(options));
                Box::new(Player::new(head, columns, hidden, device, random))
            },
        }
    }
}

/// The family that the options select; `kind = "auto"` is the law's default.
///
/// # Errors
/// If no family of that name fits the law; the error names those that do.
pub fn family<L: Perturbed>(options: &FamilyOptions) -> Result<&'static FamilyEntry<L>, String> {
    let kind = options.kind.as_str();
    let found = L::FAMILIES.iter().find(|family| kind == "auto" || family.kind == kind);
    found.ok_or_else(|| {
        let kinds: Vec<String> = L::FAMILIES.iter().map(|of| format!("{:?}", of.kind)).collect();
        format!(
            "train.family.kind = {kind:?} does not fit the law of chance of this world; use {} or \
             \"auto\"",
            kinds.join(" or ")
        )
    })
}

/// [`family`], which must keep a budget.
///
/// # Errors
/// As [`family`], and if its likelihood ratios are not bounded.
pub fn family_within_budget<L: Perturbed>(
    options: &FamilyOptions,
) -> Result<&'static FamilyEntry<L>, String> {
    let found = family::<L>(options)?;
    if !found.within_budget {
        let (kind, default) = (found.kind, L::FAMILIES[0].kind);
        return Err(format!(
            "train.family.kind = {kind:?} has likelihood ratios without a bound, for which no budget can pay; \
             use {default:?}, or the method `rarl`"
        ));
    }
    Ok(found)
}

/// A fresh antagonist that sees samples of these sizes.
///
/// # Panics
/// If no family of that name fits the law; [`family`] reports that.
pub fn antagonist<L: Perturbed>(
    options: &FamilyOptions,
    columns: Columns,
    hidden: usize,
    device: Device,
    random: &mut ChaCha8Rng,
) -> Box<dyn Antagonist<L>> {
    let entry = family::<L>(options).expect("the configuration was checked");
    (entry.antagonist)(options, Sizes { columns, hidden, device, random })
}

/// What an antagonist acts on and writes to; slices have an entry per slot.
pub struct Reweighting<'a, L: Law> {
    /// Actor outputs, shape `[k, slots]`; `None` draws the perturbation's parameters from N(0, 1).
    pub outputs: Option<&'a [f32]>,
    /// Nominal laws P_t.
    pub laws: &'a [L],
    /// Remaining budgets eta_t.
    pub budgets: &'a [Budget],
    /// The law that outcomes are drawn from.
    pub draw: Draw,
    /// Random streams.
    pub streams: &'a mut [Streams],
    /// Which of a slot's streams the outcomes are drawn from.
    pub stream: fn(&mut Streams) -> &mut ChaCha8Rng,
    /// Receives the outcomes.
    pub outcomes: &'a mut Vec<L::Outcome>,
    /// Receives their likelihood ratios.
    pub ratios: &'a mut [f64],
    /// Receives max |`E_P[delta_t]` - 1|, if it is requested.
    pub normalisation_error: Option<&'a mut f64>,
}

/// The likelihood ratio of what happened.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Ratio {
    /// delta(o).
    pub realised: f64,
    /// The infimum of delta over all that could have happened, or a lower bound of it.
    pub least: f64,
}

/// An antagonist of any family.
pub trait Antagonist<L: Law>: Debug + Send {
    /// Actor and critic.
    fn network(&self) -> &Network;

    /// The same, to be changed.
    fn network_mut(&mut self) -> &mut Network;

    /// Draws outcomes from perturbed laws.
    fn reweight(&self, of: Reweighting<'_, L>);

    /// The likelihood ratios of all outcomes, shape `[slots, outcomes]`, from actor outputs of shape
    /// `[k, slots]`; `None` where outcomes are not finitely many.
    fn all_ratios(&self, outputs: &[f32], laws: &[L], budgets: &[Budget]) -> Option<Vec<f64>>;

    /// How its own spending changes its value along the recorded trajectories. `with_more_budget` turns inputs
    /// into those that it would see with exp(the second argument) times the budget. Elasticities are cut off
    /// at `largest`.
    fn budget_sensitivity(
        &self,
        played: &Played<L>,
        with_more_budget: &dyn Fn(&mut Inputs, f64),
        largest: f32,
    ) -> BudgetSensitivity;

    /// See [`Player::estimates`].
    fn estimates(&self, played: &Played<L>, gamma: f64, options: &PlayerOptions) -> Estimates;

    /// The likelihood ratios along the recorded trajectories, if the networks are those that recorded them.
    fn ratios(&self, played: &Played<L>) -> Vec<Ratio>;

    /// A PPO update, see [`Player::update`].
    fn update(
        &mut self,
        played: &Played<L>,
        signal: Signal<'_>,
        gamma: f64,
        options: &PlayerOptions,
        rates: Rates,
        random: &mut ChaCha8Rng,
    ) -> Losses;

    /// See [`Player::not_finite`].
    fn not_finite(&self) -> Option<&'static str>;

    /// See [`Player::state`].
    fn state(&self) -> PlayerState;

    /// See [`Player::restore`].
    ///
    /// # Errors
    /// If the state is of another network or not finite.
    fn restore(&mut self, state: PlayerState) -> Result<(), Unfit>;
}

impl<F: Family + 'static> Antagonist<F::Law> for Player<AntagonistHead<F>> {
    fn network(&self) -> &Network {
        &self.network
    }

    fn network_mut(&mut self) -> &mut Network {
        &mut self.network
    }

    fn reweight(&self, of: Reweighting<'_, F::Law>) {
        let Reweighting { outputs, laws, budgets, draw, streams, stream, .. } = of;
        let Reweighting { outcomes, ratios, mut normalisation_error, .. } = of;
        let (slots, count) = (laws.len(), self.head.outputs());
        let mut parameters = vec![[0.0; SAMPLES]; count];
        for (start, streams) in (0..slots).step_by(SAMPLES).zip(streams.chunks_mut(SAMPLES)) {
            let mut random: SmallVec<[&mut ChaCha8Rng; SAMPLES]> =
                streams.iter_mut().map(stream).collect();
            let block = start..start + random.len();
            match outputs {
                Some(outputs) => self.columns_in(outputs, block.clone(), &mut parameters),
                None => {
                    for column in &mut parameters {
                        let draws = random.iter_mut().map(|random| random.sample(StandardNormal));
                        column.iter_mut().zip(draws).for_each(|(to, from)| *to = from);
                    }
                }
            }
            self.head.0.draw(Draws {
                parameters: &parameters,
                laws: &laws[block.clone()],
                budgets: &budgets[block.clone()],
                random: &mut random,
                nominal: draw == Draw::Nominal,
                outcomes,
                ratios: &mut ratios[block],
                normalisation_error: normalisation_error.as_deref_mut(),
            });
        }
    }

    fn all_ratios(&self, outputs: &[f32], laws: &[F::Law], budgets: &[Budget]) -> Option<Vec<f64>> {
        let all = || (0..).map_while(<F::Law as Law>::outcome);
        all().next()?;
        let (mut parameters, mut ratios) = (Vec::new(), Vec::new());
        for (slot, (law, &budget)) in laws.iter().zip(budgets).enumerate() {
            self.parameters_in(outputs, slot, &mut parameters);
            let perturbation = self.head.0.perturbation(&parameters, law, budget);
            ratios.extend(all().map(|outcome| perturbation.likelihood_ratio(outcome)));
        }
        Some(ratios)
    }

    fn budget_sensitivity(
        &self,
        played: &Played<F::Law>,
        with_more_budget: &dyn Fn(&mut Inputs, f64),
        largest: f32,
    ) -> BudgetSensitivity {
        let steps = played.rewards.len();
        let mut inputs = played.inputs.clone();
        let width = self.network.shape().width();
        let (mut values, mut richer, mut outputs) = (Vec::new(), Vec::new(), Vec::new());
        let [_, after] = inputs.rows().split_at(steps, width);
        self.network.values(after, &mut values);
        with_more_budget(&mut inputs, STEP);
        let [during, after] = inputs.rows().split_at(steps, width);
        self.network.values(after, &mut richer);
        self.network.act(during, &mut outputs);
        let with_more: Vec<_> = played
            .given
            .iter()
            .map(|&(law, budget)| {
                (law, Budget::remaining(budget.get() * STEP.exp()).unwrap_or(budget))
            })
            .collect();
        let mut logs = Vec::with_capacity(steps);
        self.log_probabilities(&outputs, &with_more, &played.choices, &mut logs);
        let elasticity =
            |(log, own): (&f64, &f64)| (((log - own) / STEP) as f32).clamp(-largest, largest);
        let slope = |(richer, value): (&f32, &f32)| (richer - value) / STEP as f32;
        BudgetSensitivity {
            elasticities: logs.iter().zip(&played.log_probabilities).map(elasticity).collect(),
            last: richer.iter().zip(&values).map(slope).collect(),
        }
    }

    fn estimates(&self, played: &Played<F::Law>, gamma: f64, options: &PlayerOptions) -> Estimates {
        Player::estimates(self, played, gamma, options)
    }

    fn ratios(&self, played: &Played<F::Law>) -> Vec<Ratio> {
        let (mut outputs, mut parameters) = (Vec::new(), Vec::new());
        let [during, _] =
            played.inputs.rows().split_at(played.rewards.len(), self.network.shape().width());
        self.network.act(during, &mut outputs);
        let choices = played.given.iter().zip(&played.choices).enumerate();
        choices
            .map(|(i, ((law, budget), &outcome))| {
                self.parameters_in(&outputs, i, &mut parameters);
                let perturbation = self.head.0.perturbation(&parameters, law, *budget);
                let (realised, least) =
                    (perturbation.likelihood_ratio(outcome), perturbation.infimum());
                Ratio { realised, least }
            })
            .collect()
    }

    fn update(
        &mut self,
        played: &Played<F::Law>,
        signal: Signal<'_>,
        gamma: f64,
        options: &PlayerOptions,
        rates: Rates,
        random: &mut ChaCha8Rng,
    ) -> Losses {
        Player::update(self, played, signal, gamma, options, rates, random)
    }

    fn not_finite(&self) -> Option<&'static str> {
        Player::not_finite(self)
    }

    fn state(&self) -> PlayerState {
        Player::state(self)
    }

    fn restore(&mut self, state: PlayerState) -> Result<(), Unfit> {
        Player::restore(self, state)
    }
}
