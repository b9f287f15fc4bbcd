//! `lava-grid` against tables written by hand, and its map against arbitrary text.

use lava_envs::map::{MAX_CELLS, Map, Tile};
use lava_envs::{ConfigError, Discrete, End, GridConfig, LavaGrid, Law, Move, Step, World};
use proptest::prelude::*;

fn grid(picture: &str) -> LavaGrid {
    LavaGrid::new(&GridConfig { map: picture.into(), ..GridConfig::default() }, 1).unwrap()
}

#[test]
fn the_default_map_is_the_papers() {
    let grid = LavaGrid::new(&GridConfig::default(), 1).unwrap();
    assert_eq!((grid.width(), grid.height(), grid.cells()), (10, 7, 70));
    assert_eq!(grid.coordinates(grid.start()), (0, 0));
    for cell in 0..70 {
        let (x, y) = grid.coordinates(cell);
        assert_eq!(grid.cell(x, y), cell);
        assert_eq!(grid.is_lava(cell), (2..=7).contains(&x) && y <= 1);
        assert_eq!(grid.is_goal(cell), (x, y) == (9, 0));
        assert!(!grid.is_wall(cell));
    }
}

/// Every cell and every move of a small map, as (up, down, right, left).
#[test]
fn every_step_of_a_small_map() {
    let grid = grid(
        "S#G
         ..L",
    );
    let on = |cell| (cell, Step { reward: -0.035, end: None });
    let goal = (2, Step { reward: 1.0, end: Some(End::Goal) });
    let lava = (5, Step { reward: -1.0, end: Some(End::Lava) });
    let absorbed = |cell| [(cell, Step::IDLE); 4];
    let table = [
        (0, [on(0), on(3), on(0), on(0)]), // the wall at the right, the edge above and at the left
        (2, absorbed(2)),
        (3, [on(0), on(3), on(4), on(3)]),
        (4, [on(4), on(4), lava, on(3)]), // the wall above
        (5, absorbed(5)),
    ];
    for (cell, expected) in table {
        let steps = Move::ALL.map(|executed| grid.successor(cell, executed));
        assert_eq!(steps, expected, "cell {cell}");
    }
    // From a cell below the goal, which this map does not have:
    assert_eq!(self::grid("SG").successor(0, Move::Right), (1, goal.1));
}

#[test]
fn the_batch_takes_the_steps_of_the_table() {
    let mut grid = grid("S.G\n.L.");
    let mut steps = [Step::IDLE];
    // The chosen move does not matter: chance decides which one is executed.
    let mut walk = |grid: &mut LavaGrid, moves: &[Move]| {
        grid.reset(0);
        moves
            .iter()
            .map(|executed| {
                grid.apply(&[Move::Up], &[executed.index()], &mut steps);
                (grid.position(0), steps[0].reward, steps[0].end)
            })
            .collect::<Vec<_>>()
    };
    assert_eq!(
        walk(&mut grid, &[Move::Left, Move::Right, Move::Right]),
        [
            ([0.0, 0.0], -0.035, None),
            ([1.0, 0.0], -0.035, None),
            ([2.0, 0.0], 1.0, Some(End::Goal)),
        ]
    );
    assert_eq!(
        walk(&mut grid, &[Move::Right, Move::Down]),
        [([1.0, 0.0], -0.035, None), ([1.0, 1.0], -1.0, Some(End::Lava))]
    );
}

/// The goal in the last possible step is a goal, not a time limit.
#[test]
fn the_goal_counts_in_the_last_step() {
    let config = GridConfig { map: "S.G".into(), horizon: 2, ..GridConfig::default() };
    let mut grid = LavaGrid::new(&config, 1).unwrap();
    let mut steps = [Step::IDLE];
    grid.apply(&[Move::Right], &[Move::Right.index()], &mut steps);
    grid.apply(&[Move::Right], &[Move::Right.index()], &mut steps);
    assert_eq!(steps[0], Step { reward: 1.0, end: Some(End::Goal) });
}

#[test]
fn the_chosen_move_is_executed_with_the_rest_of_the_slips() {
    let grid = grid("SG");
    let law = grid.law(0, Move::Right);
    assert_eq!(law.probabilities, [0.05 / 3.0, 0.05 / 3.0, 0.95, 0.05 / 3.0]);
    assert_eq!(law.log_density(Move::Right.index()), 0.95_f64.ln());
    let mut situation = [0.0; 6];
    grid.situation(0, Move::Right, &mut situation);
    let slip = (0.05 / 3.0) as f32;
    assert_eq!(situation, [-1.0, 0.0, slip, slip, 0.95, slip]);
}

/// Against a search over all lava cells.
#[test]
fn clearance_counts_moves_to_the_nearest_lava() {
    let mut grid = grid("S.....L\n..L....\n.......\nL.....G");
    for cell in 0..grid.cells() {
        if grid.is_lava(cell) || grid.is_goal(cell) {
            continue;
        }
        let (x, y) = grid.coordinates(cell);
        let nearest = (0..grid.cells())
            .filter(|&lava| grid.is_lava(lava))
            .map(|lava| {
                let (a, b) = grid.coordinates(lava);
                a.abs_diff(x) + b.abs_diff(y)
            })
            .min();
        // Walk there: right, then down.
        let mut steps = [Step::IDLE];
        grid.reset(0);
        let mut reached = true;
        let way = std::iter::repeat_n(Move::Down, y).chain(std::iter::repeat_n(Move::Right, x));
        for executed in way {
            grid.apply(&[executed], &[executed.index()], &mut steps);
            reached &= steps[0].end.is_none();
        }
        if reached {
            assert_eq!(grid.position(0), [x as f64, y as f64]);
            assert_eq!(grid.clearance(0), nearest.unwrap() as f64, "({x}, {y})");
        }
    }
    assert_eq!(self::grid("SG").clearance(0), f64::INFINITY);
}

fn refusal(config: &GridConfig) -> String {
    LavaGrid::new(config, 1).expect_err("the configuration should be refused").to_string()
}

#[test]
fn refusals_say_what_where_and_what_to_do() {
    let map = |picture: &str| refusal(&GridConfig { map: picture.into(), ..GridConfig::default() });
    assert_eq!(
        map("S.\n.x"),
        "map, row 2, column 2: 'x' is no cell; \
         use S (start), G (goal), g (lesser goal), L (lava), . (free) or # (wall)"
    );
    assert_eq!(
        map("  S.G\n  ..S"),
        "map, row 2, column 5: a second start S; keep exactly one and write `.` for the others"
    );
    assert_eq!(
        map("S.G\n.."),
        "map, row 2, column 3: the row has 2 cells where the first row has 3; \
         make all rows equally long"
    );
    assert_eq!(
        map("S.G\n\n..."),
        "map, row 2, column 1: an empty line inside the map; remove the line or fill it with `.`"
    );
    assert!(map("").contains("the map is empty"));
    assert!(map("..G").contains("the map has no start; write S into one free cell"));
    assert!(map("S..").contains("the map has no goal"));
    assert!(map(&".".repeat(MAX_CELLS + 1)).contains("more than 1000000 cells"));

    let value = |config: GridConfig| refusal(&config);
    assert_eq!(
        value(GridConfig { slip: 1.5, ..GridConfig::default() }),
        "slip = 1.5 is not allowed: a probability in [0, 1]"
    );
    assert!(
        value(GridConfig { slip: f64::NAN, ..GridConfig::default() }).starts_with("slip = NaN")
    );
    assert_eq!(
        value(GridConfig { step_cost: -0.035, ..GridConfig::default() }),
        "step_cost = -0.035 is not allowed: in [0, 1000000] (it is subtracted)"
    );
    let infinite = GridConfig { goal_reward: f64::INFINITY, ..GridConfig::default() };
    assert!(value(infinite).starts_with("goal_reward = inf"));
    assert!(value(GridConfig { horizon: 0, ..GridConfig::default() }).starts_with("horizon = 0"));
}

#[test]
fn configurations_are_read_from_toml() {
    let changed = LavaGrid::DEFAULTS.replace("slip = 0.05", "slip = 0.1");
    let config: GridConfig = toml::from_str(&changed).unwrap();
    assert_eq!((config.slip, config.horizon), (0.1, 40));
    let config = GridConfig { map: "\n  S.\n  LG\n".into(), ..config };
    assert_eq!(LavaGrid::new(&config, 1).unwrap().map().to_string(), "S.\nLG\n");
    let unknown = format!("slipp = 0.1\n{changed}");
    let unknown = toml::from_str::<GridConfig>(&unknown).unwrap_err();
    assert!(unknown.to_string().contains("slipp"), "{unknown}");
    let missing = changed.replace("slip = 0.1", "");
    let missing = toml::from_str::<GridConfig>(&missing).unwrap_err();
    assert!(missing.to_string().contains("slip"), "{missing}");
    let text = toml::to_string(&GridConfig::default()).unwrap();
    assert_eq!(toml::from_str::<GridConfig>(&text).unwrap(), GridConfig::default());
}

proptest! {
    #[test]
    fn arbitrary_text_never_panics(bytes in prop::collection::vec(any::<u8>(), 0..200)) {
        let _: Result<Map, ConfigError> = Map::parse(&String::from_utf8_lossy(&bytes));
    }

    /// Text made of the right characters gets further into the parser.
    #[test]
    fn almost_maps_never_panic(text in "[SGL.# \n]{0,60}") {
        if let Ok(map) = Map::parse(&text) {
            prop_assert_eq!(map.cells(), map.width() * map.height());
            prop_assert_eq!(map.tile(map.start()), Tile::Free);
        }
    }

    #[test]
    fn every_rectangle_is_read_and_drawn_alike(
        width in 1_usize..12,
        rows in prop::collection::vec(prop::collection::vec(0_usize..4, 12), 1..8),
        start in any::<prop::sample::Index>(),
        goal in any::<prop::sample::Index>(),
    ) {
        let mut cells: Vec<char> = rows
            .iter()
            .flat_map(|row| row[..width].iter().map(|&tile| [ '.', 'L', '#', 'G'][tile]))
            .collect();
        let (start, goal) = (start.index(cells.len()), goal.index(cells.len()));
        prop_assume!(start != goal);
        cells[goal] = 'G';
        cells[start] = 'S';
        let picture: String = cells
            .chunks(width)
            .flat_map(|row| row.iter().chain(std::iter::once(&'\n')))
            .collect();
        let map = Map::parse(&picture).unwrap();
        prop_assert_eq!(map.to_string(), picture);
        prop_assert_eq!((map.width(), map.height(), map.start()), (width, rows.len(), start));
    }
}
