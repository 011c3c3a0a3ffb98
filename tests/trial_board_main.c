/* The trial board's program on a computer: bytes on an inherited descriptor, the tension of a drum
 * that follows the effort halfway in each sample. Ends when the other end is closed. */
#define _DEFAULT_SOURCE
#include <errno.h>
#include <poll.h>
#include <signal.h>
#include <stdlib.h>
#include <unistd.h>

#include "estune_trial_board.c"

static int line, powered;
static double tension, effort;
static volatile sig_atomic_t unplugged; /* the gauge; SIGUSR1 pulls or plugs it */

static void replug(int number) {
  (void)number;
  unplugged = !unplugged;
}

double board_tension_N(void) {
  tension = 0.5 * tension + 0.5 * (powered ? effort : 0.0);
  return unplugged ? NAN : tension;
}
double board_angle_rad(void) { return 0.01 * tension; }
void board_effort_N(double value) { effort = value; }
void board_power(int on) {
  powered = on;
  effort = 0.0;
}
int board_receive(void) {
  unsigned char byte;
  struct pollfd waiting = {line, POLLIN, 0};
  if (poll(&waiting, 1, 0) < 1 || !(waiting.revents & POLLIN)) return -1;
  return read(line, &byte, 1) == 1 ? byte : -1;
}
void board_send(const unsigned char *bytes, int size) {
  if (write(line, bytes, (size_t)size) < 0 && errno != EAGAIN) exit(0);
}

int main(int count, char **values) {
  line = count > 1 ? atoi(values[1]) : 0;
  signal(SIGUSR1, replug);
  estune_board_init();
  for (;;) {
    estune_board_sample();
    usleep((unsigned)atoi(values[2]));
  }
}
