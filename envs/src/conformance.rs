//! What every world promises, as a suite: call [`check`] in a test of your world.
//!
//! The suite knows a world only by its traits. It draws actions by [`Action::uniform`] and outcomes by
//! [`Law::sample`], from streams of fixed seeds, so that a failure repeats. What it cannot know is
//! whether a world is the one you meant: its rewards and its dynamics need tests of their own.

use crate::action::Action;
use crate::finite::FiniteModel;
use crate::law::Law;
use crate::random::{ChaCha8Rng, Purpose, position, stream, stream_from};
use crate::scene::Field;
use crate::world::{End, Outcome, Step, World};
use std::collections::BTreeMap;

/// Seed of all streams.
const SEED: u64 = 1;

/// Slots of the batches.
const SLOTS: usize = 16;

/// The most steps that a check plays.
const MOST_STEPS: usize = 2000;

/// Largest size of an observation's entry: "about [-1, 1]" with room for unbounded quantities.
const LARGEST_ENTRY: f32 = 10.0;

/// Columns that every recorded step has besides those of its world.
const COMMON_COLUMNS: [&str; 7] = ["episode", "t", "delta", "budget", "reward", "clearance", "end"];

/// Panics with a message that begins with the world's name, unless the condition holds.
macro_rules! promise {
    ($world:ty, $condition:expr, $($message:tt)+) => {
        assert!($condition, "{}: {}", <$world>::NAME, format!($($message)+))
    };
}

/// Checks that a world with these constants keeps every promise of [`World`] and, where it has one, of
/// its [`FiniteModel`].
///
/// # Panics
/// At the first broken promise, with a message that says which one it is.
pub fn check<W: World>(constants: &W::Constants) {
    defaults::<W>();
    let world = create::<W>(constants, 3);
    promise!(W, world.constants() == constants, "constants() are not those it was made with");
    promise!(W, world.episodes() == 3, "a batch of 3 has {} slots", world.episodes());
    promise!(W, world.horizon() > 0, "the time limit is 0");
    scene(&world);
    episodes::<W>(constants);
    slots_are_independent::<W>(constants);
    snapshots::<W>(constants);
    scattered::<W>(constants);
    finite::<W>(constants);
}

fn create<W: World>(constants: &W::Constants, episodes: usize) -> W {
    if let Err(error) = W::validate(constants) {
        panic!("{}: the constants are refused: {error}", W::NAME);
    }
    W::new(constants, episodes).unwrap_or_else(|error| {
        panic!("{}: validate() accepts constants that new() refuses: {error}", W::NAME)
    })
}

/// The annotated texts are TOML, and the defaults are constants.
fn defaults<W: World>() {
    let name_is_plain =
        W::NAME.bytes().all(|b| b.is_ascii_lowercase() || b"-0123456789".contains(&b));
    promise!(
        W,
        name_is_plain && !W::NAME.is_empty(),
        "the name is for folders: use a-z, 0-9 and -"
    );
    let defaults = W::defaults(); // panics with a message of its own
    create::<W>(&defaults, 1);
    let text = toml::to_string(&defaults)
        .unwrap_or_else(|error| panic!("{}: the constants have no TOML form: {error}", W::NAME));
    let again = toml::from_str::<W::Constants>(&text);
    promise!(
        W,
        again.as_ref() == Ok(&defaults),
        "constants change when written and read: {again:?}"
    );
    let training = W::TRAINING.parse::<toml::Table>();
    promise!(W, training.is_ok(), "TRAINING is not TOML: {training:?}");
}

/// What figures draw makes sense.
fn scene<W: World>(world: &W) {
    let scene = world.scene();
    let size = scene.size;
    promise!(
        W,
        size.iter().all(|side| *side > 0.0 && side.is_finite()),
        "the scene's size is {size:?}"
    );
    for area in &scene.areas {
        let fits = (0..2).all(|axis| {
            0.0 <= area.min[axis] && area.min[axis] < area.max[axis] && area.max[axis] <= size[axis]
        });
        promise!(W, fits, "{area:?} does not fit into a scene of {size:?}");
    }
    promise!(W, scene.start == world.position(0), "the scene's start is not where episodes start");
    inside(world, 0);
}

fn inside<W: World>(world: &W, slot: usize) {
    let (scene, position) = (world.scene(), world.position(slot));
    let last = if scene.cells { 1.0 } else { 0.0 };
    let inside = (0..2).all(|axis| (0.0..=scene.size[axis] - last).contains(&position[axis]));
    promise!(W, inside, "position {position:?} lies outside the scene of {:?}", scene.size);
}

/// A scattered slot is in a state from which an episode goes on, at a time in between; the same stream
/// leads to the same state.
fn scattered<W: World>(constants: &W::Constants) {
    let mut world = create::<W>(constants, SLOTS);
    let horizon = world.horizon();
    let (mut one, mut other) = (chance(0), chance(0));
    for _ in 0..20 {
        for slot in 0..SLOTS {
            world.scatter(slot, &mut one);
            let (time, seen) = (world.time(slot), sight(&world, slot));
            promise!(W, time < horizon, "scatter() leads to time {time} of {horizon}");
            world.scatter((slot + 1) % SLOTS, &mut other);
            let again = sight(&world, (slot + 1) % SLOTS);
            promise!(W, seen == again, "scatter() depends on more than its stream");
            inside(&world, slot);
        }
        let mut results = vec![Step::IDLE; SLOTS];
        let (actions, outcomes): (Vec<_>, Vec<_>) =
            (0..SLOTS).map(|slot| draw(&world, slot, &mut chance(slot))).unzip();
        let times: Vec<u32> = (0..SLOTS).map(|slot| world.time(slot)).collect();
        world.apply(&actions, &outcomes, &mut results);
        for (slot, time) in times.into_iter().enumerate() {
            promise!(W, world.time(slot) == time + 1, "scatter() leads to a state that is over");
        }
    }
}

/// Everything that can be seen of a slot, bit for bit.
#[derive(Debug, Clone, PartialEq)]
struct Sight {
    time: u32,
    observation: Vec<u32>,
    position: [u64; 2],
    clearance: u64,
}

fn sight<W: World>(world: &W, slot: usize) -> Sight {
    Sight {
        time: world.time(slot),
        observation: observation(world, slot),
        position: world.position(slot).map(f64::to_bits),
        clearance: world.clearance(slot).to_bits(),
    }
}

/// What the protagonist sees, checked, as bits.
fn observation<W: World>(world: &W, slot: usize) -> Vec<u32> {
    let mut observation = vec![f32::NAN; W::OBSERVATION];
    world.observe(slot, &mut observation);
    for (place, entry) in observation.iter().enumerate() {
        promise!(
            W,
            entry.abs() <= LARGEST_ENTRY,
            "entry {place} of the observation is {entry}: write every entry, about [-1, 1]"
        );
    }
    let place = observation.get(..W::POSITIONS.min(W::SITUATION));
    promise!(
        W,
        place.is_some_and(
            |place| place.len() == W::POSITIONS && place.iter().all(|x| x.abs() <= 1.0)
        ),
        "POSITIONS is {}, but {observation:?} does not begin with so many coordinates in [-1, 1]",
        W::POSITIONS
    );
    observation.into_iter().map(f32::to_bits).collect()
}

/// The stream of a slot's actions and outcomes.
fn chance(slot: usize) -> ChaCha8Rng {
    stream(SEED, Purpose::Outcomes, slot as u64)
}

fn draw<W: World>(world: &W, slot: usize, random: &mut ChaCha8Rng) -> (W::Action, Outcome<W>) {
    let action = W::Action::uniform(random);
    let outcome = world.law(slot, action).sample(random);
    (action, outcome)
}

/// Plays `steps` steps of every slot, each with its stream, resets slots as soon as they have ended,
/// and shows to `see` every step: its number, the slot, the action, the outcome and the result.
fn play<W: World>(
    world: &mut W,
    chances: &mut [ChaCha8Rng],
    steps: usize,
    mut see: impl FnMut(&W, usize, usize, (W::Action, Outcome<W>), Step),
) {
    let slots = world.episodes();
    let mut results = vec![Step::IDLE; slots];
    for step in 0..steps {
        let (actions, outcomes): (Vec<_>, Vec<_>) =
            (0..slots).map(|slot| draw(world, slot, &mut chances[slot])).unzip();
        world.apply(&actions, &outcomes, &mut results);
        for (slot, result) in results.iter().enumerate() {
            see(world, step, slot, (actions[slot], outcomes[slot]), *result);
            if result.end.is_some() {
                world.reset(slot);
            }
        }
    }
}

/// Steps that contain at least two episodes of every slot, if the time limit allows it.
fn steps_of<W: World>(world: &W) -> usize {
    (world.horizon() as usize).saturating_mul(2).saturating_add(2).min(MOST_STEPS)
}

/// Names and kinds of columns.
fn heads(columns: &[(&'static str, Field)]) -> Vec<(&'static str, std::mem::Discriminant<Field>)> {
    columns.iter().map(|(name, field)| (*name, std::mem::discriminant(field))).collect()
}

/// Time, ends, columns, laws, and what the antagonist sees, along random episodes.
fn episodes<W: World>(constants: &W::Constants) {
    let mut world = create::<W>(constants, SLOTS);
    let (horizon, steps) = (world.horizon(), steps_of(&world));
    let initial = sight(&world, 0);
    promise!(W, initial.time == 0, "an episode starts at time {}", initial.time);
    let mut chances: Vec<_> = (0..SLOTS).map(chance).collect();
    let mut times = [0_u32; SLOTS];
    let mut known = None;
    play(&mut world, &mut chances, steps, |world, _, slot, (action, outcome), step| {
        times[slot] += 1;
        let (time, seen) = (times[slot], sight(world, slot));
        promise!(W, seen.time == time, "time() is {} after {time} steps", seen.time);
        promise!(W, step.reward.is_finite(), "a reward is {}", step.reward);
        match step.end {
            None => promise!(W, time < horizon, "an episode continues at its time limit {horizon}"),
            Some(End::Timeout) => {
                promise!(W, time == horizon, "the time limit {horizon} is reported at time {time}");
            }
            Some(End::Goal | End::Lava) => promise!(W, time <= horizon, "an end at time {time}"),
        }
        let clearance = world.clearance(slot);
        promise!(W, clearance >= 0.0, "a clearance is {clearance}");
        if step.end == Some(End::Lava) {
            promise!(W, clearance < 1e-6, "an episode ends in lava with clearance {clearance}");
        }
        if step.end.is_some() {
            times[slot] = 0;
        }
        inside(world, slot);
        law(world, slot, action, outcome);
        let columns =
            [world.state_columns(slot), W::action_columns(action), W::outcome_columns(outcome)];
        let columns = columns.map(|columns| heads(&columns));
        match &known {
            None => {
                let mut names: Vec<&str> = COMMON_COLUMNS.into();
                names.extend(columns.iter().flatten().map(|(name, _)| name));
                let count = names.len();
                names.sort_unstable();
                names.dedup();
                promise!(W, names.len() == count, "two columns of recorded steps share a name");
                known = Some(columns);
            }
            Some(known) => {
                promise!(W, known == &columns, "columns change from {known:?} to {columns:?}");
            }
        }
    });
    ends_are_kept::<W>(create(constants, 2), &initial);
}

/// The law of one step, and what belongs to its action and outcome.
fn law<W: World>(world: &W, slot: usize, action: W::Action, outcome: Outcome<W>) {
    let mut situation = vec![f32::NAN; W::SITUATION];
    world.situation(slot, action, &mut situation);
    let finite = situation.iter().all(|entry| entry.is_finite());
    promise!(W, finite, "what the antagonist sees is {situation:?}: write every entry");
    let law = world.law(slot, action);
    let mut numbered = (0..).map_while(W::Law::outcome).peekable();
    if numbered.peek().is_some() {
        let total: f64 = numbered.map(|outcome| law.log_density(outcome).exp()).sum();
        promise!(W, (total - 1.0).abs() < 1e-9, "the probabilities of {law:?} sum to {total}");
    }
    let arrows = [W::action_arrow(action), W::outcome_arrow(outcome)];
    promise!(W, arrows.as_flattened().iter().all(|of| of.is_finite()), "an arrow of {arrows:?}");
    let executed = W::executed(outcome);
    promise!(
        W,
        executed.is_some() == W::OUTCOMES_ARE_ACTIONS,
        "executed({outcome:?}) is {executed:?}, but OUTCOMES_ARE_ACTIONS is {}",
        W::OUTCOMES_ARE_ACTIONS
    );
    if let Some(again) = W::intended(action).and_then(W::executed) {
        promise!(W, again == action, "{action:?} is intended to be carried out as {again:?}");
    }
}

/// An ended episode waits for its reset, while the other slot continues.
fn ends_are_kept<W: World>(mut world: W, initial: &Sight) {
    let mut random = chance(SLOTS);
    let mut results = [Step::IDLE; 2];
    for _ in 0..world.horizon().min(MOST_STEPS as u32) {
        let (action, outcome) = draw(&world, 0, &mut random);
        world.apply(&[action; 2], &[outcome; 2], &mut results);
        promise!(W, results[0] == results[1], "two slots with the same steps differ: {results:?}");
        if results[0].end.is_some() {
            break;
        }
    }
    if results[0].end.is_none() {
        return; // the time limit is out of reach
    }
    let ended = sight(&world, 0);
    world.reset(1);
    let fresh = sight(&world, 1);
    promise!(W, fresh == *initial, "reset() leads to {fresh:?}, not to {initial:?}");
    let (action, outcome) = draw(&world, 1, &mut random);
    world.apply(&[action; 2], &[outcome; 2], &mut results);
    promise!(W, results[0] == Step::IDLE, "an ended episode reports {:?}", results[0]);
    promise!(W, sight(&world, 0) == ended, "an ended episode changes before its reset");
    promise!(W, world.time(1) == 1, "a slot stands still beside an ended one");
}

/// Each slot of a batch is bit for bit what it would be alone.
fn slots_are_independent<W: World>(constants: &W::Constants) {
    let mut batch = create::<W>(constants, SLOTS);
    let steps = steps_of(&batch);
    let mut chances: Vec<_> = (0..SLOTS).map(chance).collect();
    let mut recorded = vec![Vec::new(); SLOTS];
    play(&mut batch, &mut chances, steps, |world, _, slot, _, step| {
        recorded[slot].push((sight(world, slot), step));
    });
    for (slot, recorded) in recorded.iter().enumerate() {
        let mut single = create::<W>(constants, 1);
        play(&mut single, &mut [chance(slot)], steps, |world, step, _, _, result| {
            let (expected, alone) = (&recorded[step], (sight(world, 0), result));
            promise!(
                W,
                *expected == alone,
                "slot {slot} of a batch differs from an episode alone at step {step}: {expected:?}, \
                 alone {alone:?}"
            );
        });
    }
}

/// Episodes that are cut anywhere continue bit for bit in another world, in other slots.
fn snapshots<W: World>(constants: &W::Constants) {
    let mut world = create::<W>(constants, SLOTS);
    let mut chances: Vec<_> = (0..SLOTS).map(chance).collect();
    let steps = steps_of(&world).min(200);
    for cut in 0..5 {
        play(&mut world, &mut chances, 7, |_, _, _, _, _| {});
        let mut other = create::<W>(constants, SLOTS);
        let there = |slot: usize| SLOTS - 1 - slot;
        for slot in 0..SLOTS {
            let snapshot = world.snapshot(slot);
            let restored = other.restore(there(slot), snapshot);
            promise!(W, restored.is_ok(), "restore() refuses the snapshot {snapshot:?}");
            let again = other.snapshot(there(slot));
            promise!(W, again == snapshot, "{snapshot:?} is restored as {again:?}");
        }
        let again =
            |(slot, random)| stream_from(SEED, Purpose::Outcomes, slot as u64, position(random));
        let mut others: Vec<_> = chances.iter().enumerate().map(again).rev().collect();
        let mut recorded = vec![Vec::new(); SLOTS];
        play(&mut world, &mut chances, steps, |world, _, slot, _, step| {
            recorded[slot].push((sight(world, slot), step));
        });
        play(&mut other, &mut others, steps, |world, step, slot, _, result| {
            let expected = &recorded[there(slot)][step];
            promise!(
                W,
                *expected == (sight(world, slot), result),
                "a restored episode continues otherwise (cut {cut}, step {step})"
            );
        });
    }
}

/// The finite model, if there is one, describes the same world.
fn finite<W: World>(constants: &W::Constants) {
    let mut world = create::<W>(constants, SLOTS);
    let has_model = world.finite().is_some();
    let same = world.finite_mut().is_some() == has_model;
    promise!(W, same, "only one of finite() and finite_mut() has a model");
    let Some(model) = world.finite() else { return };
    model_is_sane::<W>(&world, model);

    let steps = steps_of(&world);
    let mut chances: Vec<_> = (0..SLOTS).map(chance).collect();
    let start = model.start();
    let mut states = [start; SLOTS];
    let mut seen = BTreeMap::new();
    let mut indices = Indices::<W>::new(model);
    play(&mut world, &mut chances, steps, |world, _, slot, (action, outcome), step| {
        let model = world.finite().expect("it had a model before");
        let (state, next) = (states[slot], model.state(slot));
        let index = (0..model.outcomes()).find(|&of| W::Law::outcome(of) == Some(outcome));
        let Some(index) = index else {
            panic!("{}: the outcome {outcome:?} has no index in the model", W::NAME)
        };
        let end = step.end.filter(|end| *end != End::Timeout);
        let taken = (next, step.reward, end);
        indices.keep(action, "leads where apply() leads", |of| {
            let (successor, expected) = model.successor(state, of, index);
            (successor, expected.reward, expected.end) == taken
        });
        indices.keep(action, "has the same arrow", |of| model.arrow(of) == W::action_arrow(action));
        let intended = W::intended(action);
        indices.keep(action, "intends the same outcome", |of| {
            intended == model.intended_outcome(of).and_then(W::Law::outcome)
        });
        let over = model.is_over(slot);
        promise!(W, over == step.end.is_some(), "is_over() is {over} after {step:?}");
        if step.end.is_none() {
            let here = (observation(world, slot), world.position(slot).map(f64::to_bits));
            let before = seen.entry(next).or_insert_with(|| here.clone());
            promise!(W, *before == here, "state {next} is seen in two ways");
        }
        states[slot] = if step.end.is_some() { start } else { next };
    });
    placing(&mut world, &seen, &mut indices);
}

/// Which of the model's actions each action of the world may be, by all that was seen of it.
struct Indices<W: World> {
    all: Vec<usize>,
    candidates: Vec<(W::Action, Vec<usize>)>,
}

impl<W: World> Indices<W> {
    fn new(model: &dyn FiniteModel) -> Self {
        Indices { all: (0..model.actions()).collect(), candidates: Vec::new() }
    }

    /// Keeps the candidates of which something is true as it is of the action.
    fn keep(&mut self, action: W::Action, what: &str, mut is_true: impl FnMut(usize) -> bool) {
        let known = self.candidates.iter().position(|(of, _)| *of == action);
        let known = known.unwrap_or_else(|| {
            self.candidates.push((action, self.all.clone()));
            self.candidates.len() - 1
        });
        let candidates = &mut self.candidates[known].1;
        candidates.retain(|&of| is_true(of));
        promise!(W, !candidates.is_empty(), "no action of the model {what} as {action:?} does");
    }
}

fn model_is_sane<W: World>(world: &W, model: &dyn FiniteModel) {
    let (states, start) = (model.states(), model.start());
    promise!(W, start < states, "the start {start} is none of {states} states");
    promise!(W, model.ended(start).is_none(), "an episode starts where it ends");
    promise!(W, model.state(0) == start, "a new slot is in state {}", model.state(0));
    let names: Vec<&str> = (0..model.actions()).map(|action| model.action_name(action)).collect();
    let mut distinct = names.clone();
    distinct.sort_unstable();
    distinct.dedup();
    promise!(W, distinct.len() == names.len(), "two actions share a name: {names:?}");
    let size = world.scene().size;
    for state in 0..states {
        let [x, y] = model.coordinates(state);
        let inside = (x as f64) < size[0] && (y as f64) < size[1];
        promise!(W, inside, "state {state} at ({x}, {y}) lies outside the scene of {size:?}");
        if model.ended(state).is_some() {
            continue;
        }
        for action in 0..model.actions() {
            let law = model.probabilities(state, action);
            let total: f64 = law.iter().sum();
            let is_law = law.len() == model.outcomes()
                && law.iter().all(|p| *p >= 0.0)
                && (total - 1.0).abs() < 1e-9;
            promise!(W, is_law, "{law:?} is no law over {} outcomes", model.outcomes());
            let intended = model.intended_outcome(action);
            promise!(W, intended.is_none_or(|of| of < law.len()), "no outcome {intended:?}");
        }
        for (action, outcome) in (0..model.actions())
            .flat_map(|action| (0..model.outcomes()).map(move |of| (action, of)))
        {
            let (next, step) = model.successor(state, action, outcome);
            promise!(W, next < states, "state {state} leads to {next}, but there are {states}");
            let end = model.ended(next);
            promise!(
                W,
                step.end == end,
                "state {next} ends by {end:?}, the step to it by {step:?}"
            );
        }
    }
}

/// A slot that is put into a state is like an episode that has come there, and has its laws.
fn placing<W: World>(
    world: &mut W,
    seen: &BTreeMap<usize, (Vec<u32>, [u64; 2])>,
    indices: &mut Indices<W>,
) {
    let mut random = chance(0);
    for (&state, expected) in seen {
        for time in [0, world.horizon() - 1] {
            let Some(model) = world.finite_mut() else { return };
            model.place(0, state, time);
            let found = (model.state(0), model.is_over(0));
            promise!(W, found == (state, false), "place({state}) leads to {found:?}");
            promise!(W, world.time(0) == time, "place() at {time} leads to {}", world.time(0));
            let here = (observation(world, 0), world.position(0).map(f64::to_bits));
            promise!(W, here == *expected, "state {state} looks different when it is placed");
        }
        let Some(model) = world.finite() else { return };
        for _ in 0..4 {
            let action = W::Action::uniform(&mut random);
            let law = world.law(0, action);
            let outcomes = (0..model.outcomes()).filter_map(W::Law::outcome);
            let law: Vec<f64> = outcomes.map(|of| law.log_density(of).exp()).collect();
            indices.keep(action, "has the same law", |of| {
                let known = model.probabilities(state, of);
                known.len() == law.len()
                    && known.iter().zip(&law).all(|(a, b)| (a - b).abs() < 1e-9)
            });
        }
    }
}
