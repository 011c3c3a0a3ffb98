"""Margins and gains from records of a loop in ordinary service.

A log of setpoint and measurement, the gains that ran and the controller's form are enough; no step
is needed, nor rest, nor a chosen window. The steps, one file each:

    sources           logs below a path, in any format of `estune.recordings`, or of a run
    stretches         parts without a gap, and those in which the controller's equation holds
    usable            the same of whole folders, before anything is fitted
    cause             whether it is the tuning or the machine, by the three signals alone
    replay            the logged effort against that of the stated gains, before anything else
    controller_search its derivative and setpoint filters where others ran than stated
    gain_sets         several sets of gains within one log
    fitted_part       of long records what is fitted, and whether it speaks for the rest
    identification    the loop by a direct fit with a model of load, drift and noise
    ringing           a loop that rings, with its period
    judgement         whether the records show the margins of the gains in use
    recommendation    the best gains whose limits hold by the upper ends of their intervals
    advice            the experiment that shows what the records do not
    judged_records    what all of it found, as a value
    suggestion        the steps in their order
    page              the report
    watched_loop      the same record by record: margins, and whether the plant has changed
    plant_change      what records show of another plant, which adds up over them

What was not obvious:

* The fit's own interval is not the measure of what is known. Under a slow load a loop that holds
  still is fitted with a narrow interval and a wrong Ms, since load and noise alone move it. The
  interval that counts only what the setpoint excites decides.
* The logged effort drives the plant at a limit or by hand as well. Whole parts are fitted, limits
  cut no hole into them: of two cold starts with one setpoint nothing else shows the loop (Ms 1.59
  and 2.34 for 1.59 and 2.35). A cold start is fitted behind a rest, for its first samples, which
  would else serve as the past of the others, show the most.
* The effort is replayed first. Eleven measured logs of a heated chamber name gains in their file
  names; in two of them others ran, which moves Ms from 2.5 to 1.9. By least squares the logged
  effort shows those that did.
* Another rule of integration acts as another P: where the stated gains explain the effort in
  another form of the controller, the form is said to differ and not the gains.
* One record of 80 settling times with 1 % dither hardly shows 30 % more gain of a sluggish loop:
  chi-squared is 10 to 30 with five degrees of freedom, and 30 is chance at 1e-5. A test of each
  record by itself, after which it is fitted, lets the fit follow the change. So records that look
  different are set apart, and their scores add up; along the gain alone they are one number.
* Costs are flat about their optimum and limits are not: at a predicted Ms of 1.60 half of the
  loops lie above it. So limits are kept by the upper ends of intervals, and the price of that is
  told.
"""
