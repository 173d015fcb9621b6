import cProfile, pstats, time
def test_again(scripted):
    f = scripted(); t=time.process_time(); print(f.run()); print("first", time.process_time()-t, f.link.time)
def test_again2(scripted):
    f = scripted()
    t=time.process_time()
    print(f.run())
    print("second", time.process_time()-t, f.link.time, len(f.link.log))
    print(f.user.told)
