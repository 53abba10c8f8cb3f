// A node without a middleware: does what standard input says. Built by tests.tools.preload.
//
//   take SERVICE SEQUENCE WAITED_MS   send SERVICE SEQUENCE STATUS   hear TOPIC STAMP WAITED_MS   say TOPIC STAMP
//   hear_raw, say_raw: the same, serialised   hear_too: by another subscription   goal SERVICE SEQUENCE UUID   fail: from now on nothing works
//   sleep MS: by the scripted clock   loop COUNT: so many requests of /plan, then their CPU time in nanoseconds each
#include <stdint.h>
#include <stdio.h>
#include <string.h>
#include <time.h>

extern int64_t received_ns;
extern uint8_t header[24];
extern int32_t code;
extern int64_t elapsed_ns;
int32_t rcl_take_request(const void *, void *, void *);
int32_t rcl_take_request_with_info(const void *, void *, void *);
int32_t rcl_send_response(const void *, void *, void *);
int32_t rcl_take(const void *, void *, void *, void *);
int32_t rcl_take_serialized_message(const void *, void *, void *, void *);
int32_t rcl_publish(const void *, const void *, void *);
int32_t rcl_publish_serialized_message(const void *, const void *, void *);

static int64_t now_ns(clockid_t clock) {
  struct timespec t;
  clock_gettime(clock, &t);
  return t.tv_sec * 1000000000LL + t.tv_nsec;
}

static void numbered(long number) {
  memset(header, 0, sizeof header);
  memcpy(header + 16, &number, sizeof number);
}

static void loop(long count) {
  uint64_t info[32], response = 0;
  elapsed_ns = -1;  // CPU time is the host's
  int64_t begun = now_ns(CLOCK_PROCESS_CPUTIME_ID);
  for (long i = 0; i < count; i++) {
    numbered(i);
    received_ns = now_ns(CLOCK_REALTIME);
    rcl_take_request_with_info("/plan", info, &response);
    rcl_send_response("/plan", header, &response);
  }
  printf("%lld\n", (long long)(now_ns(CLOCK_PROCESS_CPUTIME_ID) - begun) / count);
}

int main(void) {
  char line[256], what[32], name[128], too[128];
  while (fgets(line, sizeof line, stdin)) {
    long number = 0, more = 0;
    sscanf(line, "%31s", what);
    if (sscanf(line, "%*s %127s %ld %ld", name, &number, &more) < 1) name[0] = 0;
    uint8_t message[64] = {0}, cdr[64] = {0, 1, 0, 0}, head[24] = {0};
    struct { uint8_t *buffer; size_t length, capacity; } bytes = {cdr, sizeof cdr, sizeof cdr};
    long milliseconds = 0;
    sscanf(line, "%*s %ld", &milliseconds);
    int32_t stamp = (int32_t)number;
    memcpy(message, &stamp, 4), memcpy(cdr + 4, &stamp, 4);
    received_ns = more < 0 ? 0 : now_ns(CLOCK_REALTIME) - more * 1000000;
    if (!strcmp(what, "take")) numbered(number), rcl_take_request(name, head, message);
    if (!strcmp(what, "goal")) message[0] = (uint8_t)more, received_ns = 0, numbered(number), rcl_take_request(name, head, message);
    if (!strcmp(what, "send")) message[0] = (uint8_t)more, numbered(number), rcl_send_response(name, header, message);
    if (!strcmp(what, "hear")) rcl_take(name, message, NULL, NULL);
    if (!strcmp(what, "hear_too")) rcl_take(strcpy(too, name), message, NULL, NULL);
    if (!strcmp(what, "say")) rcl_publish(name, message, NULL);
    if (!strcmp(what, "hear_raw")) rcl_take_serialized_message(name, &bytes, NULL, NULL);
    if (!strcmp(what, "say_raw")) rcl_publish_serialized_message(name, &bytes, NULL);
    if (!strcmp(what, "fail")) code = 1;
    if (!strcmp(what, "sleep")) elapsed_ns += milliseconds * 1000000;
    if (!strcmp(what, "loop")) sscanf(line, "%*s %ld", &number), loop(number);
  }
}
