// Times the requests of one service, action or pair of topics of an unmodified node, from inside its process.
//
// preload.py compiles it on the measured machine and puts it into LD_PRELOAD of the measured process alone. It wraps
// the functions of rcl that take requests and send responses, for any rmw and any client library; the graph is unchanged.
// No headers of ROS 2 are needed: every structure that is looked into begins with the same fields in Humble, Jazzy and later.
#include "preload.h"

#include <dlfcn.h>
#include <link.h>
#include <stdbool.h>

#define INFO 256  // more than any rmw_message_info_t or rmw_service_info_t

typedef int32_t ret_t;                                              // rcl_ret_t
typedef struct { uint8_t *buffer; size_t length; } serialized_t;    // the beginning of rcl_serialized_message_t
typedef struct { int64_t source_ns, received_ns; } times_t;         // the beginning of both info structures
typedef const char *(*name_function)(const void *);

static bool is(const char *variable, const char *name, const char *suffix) {
  const char *wanted = setting(variable);
  if (!wanted || !name) return false;
  size_t length = strlen(wanted);
  return strncmp(name, wanted, length) == 0 && strcmp(name + length, suffix) == 0;
}

// ---- the functions behind the wrappers -------------------------------------------------------------------------------

static int find_rcl(struct dl_phdr_info *object, size_t size, void *found) {
  (void)size;
  const char *file = object->dlpi_name ? strrchr(object->dlpi_name, '/') : NULL;
  if (!file || (strncmp(file, "/librcl.so", 10) != 0 && strncmp(file, "/librcl-", 8) != 0)) return 0;
  *(void **)found = dlopen(object->dlpi_name, RTLD_LAZY | RTLD_NOLOAD);
  return 1;
}

static void *real(const char *name) {
  void *function = dlsym(RTLD_NEXT, name), *library = NULL;
  // Python loads rcl out of reach of RTLD_NEXT.
  if (!function && dl_iterate_phdr(find_rcl, &library) && library) function = dlsym(library, name);
  if (!function) {
    fprintf(stderr, "fogspec: %s is called, and no librcl is loaded\n", name);
    abort();
  }
  return function;
}

#define REAL(name) ({ static void *found; if (!found) found = real(name); found; })

// ---- services and actions --------------------------------------------------------------------------------------------

static const char *service_name(const void *service) { return ((name_function)REAL("rcl_service_get_service_name"))(service); }

// A goal's latency is from the request that brought it to the response that takes its result away. Both requests begin with
// the goal's UUID; both responses only name the request that they answer.
static struct { bool used; uint8_t request[KEY], goal[KEY]; } goals[PENDING];

static void remember_goal(const void *header, const void *request) {
  static unsigned next;
  pthread_mutex_lock(&lock);
  unsigned i = next++ % PENDING;
  goals[i].used = true;
  key_of(goals[i].request, header, KEY);
  key_of(goals[i].goal, request, 16);
  pthread_mutex_unlock(&lock);
}

static bool goal_of(uint8_t *goal, const void *header) {
  bool found = false;
  pthread_mutex_lock(&lock);
  for (int i = 0; i < PENDING && !found; i++)
    if (goals[i].used && memcmp(goals[i].request, header, KEY) == 0) {
      found = true;
      goals[i].used = false;
      memcpy(goal, goals[i].goal, KEY);
    }
  pthread_mutex_unlock(&lock);
  return found;
}

static void took_request(const void *service, const void *header, const void *request, int64_t taken_ns, int64_t received_ns) {
  const char *name = service_name(service);
  bool sent = is("FOGSPEC_PRELOAD_ACTION", name, "/_action/send_goal");
  uint8_t key[KEY];
  if (sent || is("FOGSPEC_PRELOAD_ACTION", name, "/_action/get_result")) remember_goal(header, request);
  if (sent || is("FOGSPEC_PRELOAD_SERVICE", name, "")) {
    key_of(key, sent ? request : header, sent ? 16 : KEY);
    take(sent ? setting("FOGSPEC_PRELOAD_ACTION") : name, NULL, key, taken_ns, received_ns);
  } else if (!strstr(name, "/_action/")) {
    write_other(name);
  }
}

// The first byte of a response: whether a goal is accepted, or its action_msgs/msg/GoalStatus.
static const char *failure_of(int8_t status) {
  return status == 4 ? NULL : status == 5 ? "the goal was canceled" : status == 6 ? "the goal was aborted" : "no result";
}

static void sent_response(const void *service, const void *header, const void *response) {
  const char *name = service_name(service), *action = setting("FOGSPEC_PRELOAD_ACTION");
  const int8_t first = *(const int8_t *)response;
  uint8_t key[KEY], goal[KEY];
  key_of(key, header, KEY);
  if (is("FOGSPEC_PRELOAD_SERVICE", name, "")) {
    depart(name, key, NULL);
  } else if (is("FOGSPEC_PRELOAD_ACTION", name, "/_action/send_goal")) {
    if (goal_of(goal, key) && !first) depart(action, goal, "the goal was refused");
  } else if (is("FOGSPEC_PRELOAD_ACTION", name, "/_action/get_result")) {
    if (goal_of(goal, key)) depart(action, goal, failure_of(first));
  }
}

ret_t rcl_take_request_with_info(const void *service, void *info, void *request) {
  ret_t (*function)(const void *, void *, void *) = REAL("rcl_take_request_with_info");
  int64_t taken_ns = now_ns(CLOCK_MONOTONIC);
  ret_t code = function(service, info, request);
  const times_t *times = info;  // followed by the rmw_request_id_t
  if (code == 0) took_request(service, times + 1, request, taken_ns, times->received_ns);
  return code;
}

ret_t rcl_take_request(const void *service, void *header, void *request) {
  uint64_t info[INFO / 8] = {0};  // with times, which give the request's arrival
  ret_t code = rcl_take_request_with_info(service, info, request);
  memcpy(header, (const times_t *)info + 1, KEY);
  return code;
}

ret_t rcl_send_response(const void *service, void *header, void *response) {
  ret_t (*function)(const void *, void *, void *) = REAL("rcl_send_response");
  ret_t code = function(service, header, response);
  if (code == 0) sent_response(service, header, response);
  return code;
}

// ---- topics ----------------------------------------------------------------------------------------------------------

// Both in C and in C++ a message that begins with a std_msgs/Header begins with its stamp; its CDR does after four bytes.
static const uint8_t *stamp_of(uint8_t *key, const void *message, const serialized_t *bytes) {
  if (!setting("FOGSPEC_STAMPED")) return NULL;
  if (bytes && bytes->length < 12) return NULL;
  key_of(key, bytes ? bytes->buffer + 4 : message, 8);
  return key;
}

static void took(const void *subscription, const void *message, const serialized_t *bytes, int64_t taken_ns, const times_t *times) {
  uint8_t key[KEY];
  const char *name = ((name_function)REAL("rcl_subscription_get_topic_name"))(subscription);
  if (is("FOGSPEC_PRELOAD_REQUEST", name, "")) take(setting("FOGSPEC_PRELOAD_RESPONSE"), subscription, stamp_of(key, message, bytes), taken_ns, times->received_ns);
  else if (setting("FOGSPEC_PRELOAD_REQUEST") && !strstr("/clock /parameter_events /rosout", name)) write_other(name);
}

static void published(const void *publisher, const void *message, const serialized_t *bytes) {
  uint8_t key[KEY];
  const char *name = ((name_function)REAL("rcl_publisher_get_topic_name"))(publisher);
  if (is("FOGSPEC_PRELOAD_RESPONSE", name, "")) depart(name, stamp_of(key, message, bytes), NULL);
}

ret_t rcl_take(const void *subscription, void *message, void *info, void *allocation) {
  ret_t (*function)(const void *, void *, void *, void *) = REAL("rcl_take");
  uint64_t own[INFO / 8] = {0};
  int64_t taken_ns = now_ns(CLOCK_MONOTONIC);
  ret_t code = function(subscription, message, info ? info : own, allocation);
  if (code == 0) took(subscription, message, NULL, taken_ns, info ? info : (void *)own);
  return code;
}

ret_t rcl_take_serialized_message(const void *subscription, void *bytes, void *info, void *allocation) {
  ret_t (*function)(const void *, void *, void *, void *) = REAL("rcl_take_serialized_message");
  uint64_t own[INFO / 8] = {0};
  int64_t taken_ns = now_ns(CLOCK_MONOTONIC);
  ret_t code = function(subscription, bytes, info ? info : own, allocation);
  if (code == 0) took(subscription, NULL, bytes, taken_ns, info ? info : (void *)own);
  return code;
}

ret_t rcl_take_loaned_message(const void *subscription, void **message, void *info, void *allocation) {
  ret_t (*function)(const void *, void **, void *, void *) = REAL("rcl_take_loaned_message");
  uint64_t own[INFO / 8] = {0};
  int64_t taken_ns = now_ns(CLOCK_MONOTONIC);
  ret_t code = function(subscription, message, info ? info : own, allocation);
  if (code == 0) took(subscription, *message, NULL, taken_ns, info ? info : (void *)own);
  return code;
}

ret_t rcl_publish(const void *publisher, const void *message, void *allocation) {
  ret_t (*function)(const void *, const void *, void *) = REAL("rcl_publish");
  ret_t code = function(publisher, message, allocation);
  if (code == 0) published(publisher, message, NULL);
  return code;
}

ret_t rcl_publish_serialized_message(const void *publisher, const void *bytes, void *allocation) {
  ret_t (*function)(const void *, const void *, void *) = REAL("rcl_publish_serialized_message");
  ret_t code = function(publisher, bytes, allocation);
  if (code == 0) published(publisher, NULL, bytes);
  return code;
}

ret_t rcl_publish_loaned_message(const void *publisher, void *message, void *allocation) {
  ret_t (*function)(const void *, void *, void *) = REAL("rcl_publish_loaned_message");
  uint8_t stamp[8] = {0};  // once it is published, the message is no longer ours to look at
  memcpy(stamp, message, setting("FOGSPEC_STAMPED") ? 8 : 0);
  ret_t code = function(publisher, message, allocation);
  if (code == 0) published(publisher, stamp, NULL);
  return code;
}
