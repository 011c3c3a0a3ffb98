"""The control loop as identified from records: predictions, margins, and what may be claimed.

Theory of operation
-------------------

A record is setpoint, measurement and effort of a loop in operation: a step trial from rest, or
ordinary service with any setpoint (`records`). The plant is y = G u + H e, u the effort, e
white.

- `poles`, `model`: G has up to six poles in second-order sections, a numerator of one term more
  in powers of 1 - q^-1, and a dead time of whole samples. Both keep their digits at hundreds of
  samples a period. Ms is read on a grid that is finer about each resonance, and again about its
  peak; the loop is stable where the characteristic polynomial neither turns about the origin nor
  is negative at one: without the second a negative gain had Ms 1.31 with a pole at 1.015.
- `growing_poles`: poles outside the unit circle are searched where a fit without them leaves
  errors. The predictor is the same one for all plants, and needs no controller: their output
  error is taken through an all-pass, which keeps it finite and white (`least_squares`).
- `noise_model`: H holds a load at the input, a drift at the output and the noise of the sensor,
  white or of a colour that its errors show (`sensor_colour`).
- `drawn_models` are models that the records allow: linear in the coefficients of A and B, which
  the records know where they do not know each pole.
- `fit_signals`: records as deviations; what each has of its own beside the plant is `nuisance`.
- `least_squares`: for given poles, noise and dead time all else is linear. `identification`
  searches these few numbers from where `beginning` says; `order` adds poles (`further_poles`), a
  load or a drift where prediction errors are not white (`whiteness`) and the Bayesian information
  criterion (`criterion`) falls; `slow_poles` are integrators to the records; `friction` does so
  for dry friction (`friction_motion`), in service also where a load makes them white
  (`friction_score`); friction of another law shows by errors or a plant that change with motion
  (`motion_score`). Either is what no linear past explains (`linear_past`).
- `hum` finds a line that stands at rest; it is free in each record, like its offsets.
- `fitting` tries models in turn. It leaves out excitations that spoil the fit of the steps, and
  records that the others contradict (`contradiction`), up to a quarter.
- `damping` is the posterior mean of what the records do not tell from zero.
- `near_fit` is the loop of the trials near some gains, where no linear model explains all.
- `plant_error` bounds what the true plant may differ from G by, in each band; `agreement` finds
  gains whose trials show another loop; `intervals` holds the uncertainty of the parameters;
  `claim` says what of the loop is known, or which band is not, and `excitation` how large a
  multisine on the setpoint would make it known.
- `rival` is the model of one pair of poles more that the criterion refuses and the likelihood does
  not: recommended gains keep their limits with it, too.
- `compiled`: what a search asks for most, closed loops (`closed_loops`) and prediction errors
  with white noise (`compiled_errors`), is C; without a compiler NumPy finds the same.
- `optimum`, `drawn_optima`, `limit_price`, `prediction`, `sampled_loop`: the best gains within
  limits, by the model.

What is guaranteed
------------------

Margins are claimed only of a loop that the identified one predicts, with two trials near its
gains, and whose plant is known wherever the controller's gain times the plant's error matters
against |1 + L|. The upper end of the interval of Ms contains that error, and Ms by the trials of
each gains that no model of all explains. It is a statement on the linear part at the amplitude of
the records. A mode whose damping is below 2 % is bounded as
far as the records resolve it.

Choices that are not obvious
----------------------------

- Records from rest have free start states of the first pair of poles only. With free states of a
  mode a damping of 0.6 % was fitted as zero: the states of seven records took up noise, most
  where the mode hardly decays.
- The criterion counts the start states of every record. Without them it chose a drift of size
  1e-11, because a noise model has more of them.
- Load and drift are searched before the colour, and the colour before further poles: a plant that
  is given the sensor's colour has poles that it has not. A load explains what a slow pole does;
  where there is one, a slow pole is tried in its place.
- In trials from rest a load is searched where further poles leave something, and kept only if it
  leaves nothing and holds before the steps. Else what is left of them counts as error of the
  plant: the answer of one that is not linear repeats with every trial and does not average out.
- The direct method uses what the noise excites through the feedback, too. It excites a band the
  more, the more the controller does there, which is where it matters: ten records of the
  reference reel bound the share of |1 + L| to 0.27 up to half the sampling rate, four records to
  0.9.
- Friction and modes are compared by the criterion. Six poles fit the friction of the reference
  reel as well as a linear model can; one friction parameter fits it better.

What was tried and lost
-----------------------

- Draws along the logarithms of the poles: of two close poles, or of one that hardly matters, each
  moves far without moving A, and the numerator not with it. On a lag of 86 ms the interval of Ms
  was 1.57 to 7.1 where it is 1.57 to 1.63.
- Noise of first differences before the step: with 20 samples before it a noise of 2 % was 0.6 %
  of misfit. What the model leaves has as many samples as there are, and no response in it.
- A limit of the misfit as a share of the step: a narrow mode has little of it. On a 4 Hz plant
  with a mode at 60 Hz 0.29 % allowed a claim of 1.67 where Ms was 2.05.
- The frequency of a mode begun at the peak of the residual's spectrum alone: the loop moves it
  by more than its width, and the search ended beside it. Starts lie up to a bin to both sides.
"""
