"""The cause of a restless loop: its tuning, its actuator, its sensor, or something outside.

From setpoint, measurement and output alone, gains known or not. The steps, one file each:

    loop_signals  the three signals at the pace of the loop, its swings, and its controller
    valve         a sticking actuator of two parameters
    predictors    a linear loop and one whose actuator sticks, by what they predict
    sensor        frozen readings, steps, spikes and noise
    outside       a line or steps in the disturbance that the linear loop leaves
    margins       how tight the identified loop is, and how much less would do
    evidence      all of it as numbers
    judge         the cause, with its probability, in words

What was not obvious:

* In closed loop the output follows the measurement: u' = K e is exact, so that a law from output
  to measurement may describe the controller's inverse. A valve's law fits the records of sound
  integral control better than any linear loop does (six of twenty simulated ones by more than half
  of the variance). So only predictions from the past count; the best of a linear loop is linear.
* Nearly every measured loop has noise of several paces. With an autoregression over lags of 1 to
  128 samples, in means of doubling length, a slow drift is told from white noise in nine numbers;
  with one of six lags the sinusoids of a sound level loop were told to stick.
"""
