// A librcl.so that has no middleware: requests come from the program that calls it. Built by tests.tools.preload.
#define _GNU_SOURCE
#include <stdint.h>
#include <string.h>
#include <sys/syscall.h>
#include <time.h>
#include <unistd.h>

int64_t received_ns;      // what the middleware says of a request's arrival, on the wall clock
uint8_t header[24];       // rmw_request_id_t
int32_t code;             // what the functions return
int64_t elapsed_ns;       // scripted time; negative for the host's own clocks

// In the place of libc's, for the library as well: what it reads is what the program says, on the fastest and the slowest host.
int clock_gettime(clockid_t clock, struct timespec *t) {
  if (elapsed_ns < 0) return (int)syscall(SYS_clock_gettime, clock, t);
  int64_t since_s = clock == CLOCK_REALTIME ? 1700000000 : 100000;
  t->tv_sec = since_s + elapsed_ns / 1000000000, t->tv_nsec = elapsed_ns % 1000000000;
  return 0;
}

const char *rcl_service_get_service_name(const void *name) { return name; }
const char *rcl_subscription_get_topic_name(const void *name) { return name; }
const char *rcl_publisher_get_topic_name(const void *name) { return name; }

int32_t rcl_take_request_with_info(const void *s, void *info, void *request) {
  (void)s, (void)request;
  ((int64_t *)info)[1] = received_ns;
  memcpy((int64_t *)info + 2, header, sizeof header);
  return code;
}
int32_t rcl_take_request(const void *s, void *head, void *request) { (void)s, (void)request, memcpy(head, header, 24); return code; }
int32_t rcl_send_response(const void *s, void *head, void *response) { (void)s, (void)head, (void)response; return code; }
int32_t rcl_take(const void *s, void *message, void *info, void *a) {
  (void)s, (void)message, (void)a;
  if (info) ((int64_t *)info)[1] = received_ns;
  return code;
}
int32_t rcl_take_serialized_message(const void *s, void *m, void *info, void *a) { return rcl_take(s, m, info, a); }
int32_t rcl_take_loaned_message(const void *s, void **m, void *info, void *a) { (void)m; return rcl_take(s, 0, info, a); }
int32_t rcl_publish(const void *p, const void *m, void *a) { (void)p, (void)m, (void)a; return code; }
int32_t rcl_publish_serialized_message(const void *p, const void *m, void *a) { return rcl_publish(p, m, a); }
int32_t rcl_publish_loaned_message(const void *p, void *m, void *a) { return rcl_publish(p, m, a); }
