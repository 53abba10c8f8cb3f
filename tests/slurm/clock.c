/* The date that a process is told: that of the host, and so many seconds later as the file of FOGSPEC_TEST_CLOCK says.

   To be preloaded. The file is shared, so that the date jumps for all processes that read it at once, in the middle of what
   they do, as it does when somebody sets a host's clock. Clocks that never jump are left alone. */
#define _GNU_SOURCE
#include <fcntl.h>
#include <stdint.h>
#include <stdlib.h>
#include <sys/mman.h>
#include <sys/syscall.h>
#include <sys/time.h>
#include <time.h>
#include <unistd.h>

static const volatile int64_t none_s, *jump_s = &none_s;

__attribute__((constructor)) static void begin(void) {
  const char *path = getenv("FOGSPEC_TEST_CLOCK");
  int file = path ? open(path, O_RDONLY | O_CLOEXEC) : -1;
  if (file < 0) return;
  void *there = mmap(NULL, sizeof *jump_s, PROT_READ, MAP_SHARED, file, 0);
  if (there != MAP_FAILED) jump_s = there;
  close(file);
}

int clock_gettime(clockid_t which, struct timespec *at) {
  int code = (int)syscall(SYS_clock_gettime, which, at);
  if (!code && (which == CLOCK_REALTIME || which == CLOCK_REALTIME_COARSE)) at->tv_sec += *jump_s;
  return code;
}

int gettimeofday(struct timeval *restrict at, void *restrict zone) {
  int code = (int)syscall(SYS_gettimeofday, at, zone);
  if (!code) at->tv_sec += *jump_s;
  return code;
}

time_t time(time_t *out) {
  struct timespec at;
  clock_gettime(CLOCK_REALTIME, &at);
  if (out) *out = at.tv_sec;
  return at.tv_sec;
}
